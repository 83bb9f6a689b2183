"""Geometry that several parts use: pairs and ICP, ground, visual hull, visibility, matching of patches."""
