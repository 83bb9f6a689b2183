"""Where the object stands in the scene: scale, candidates, refinement, decision, uncertainty."""
