"""Where the object stands in the scene: crop, alignment, scale, coarse and fine registration, decision."""
