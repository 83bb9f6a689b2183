"""Where a model lies on the earth: GPS, control points, given clouds, what is left over."""
