"""Objects that repeat themselves: by which shifts, and whether the scene tells which of them is right."""
