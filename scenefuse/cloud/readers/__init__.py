"""Readers of single formats of clouds and meshes, as named columns."""
