"""A local page to click in: what is the object in its photos, and named points in the scene's."""
