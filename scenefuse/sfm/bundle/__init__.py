"""Bundle adjustment of COLMAP models: lenses, and how far a model may be bent."""
