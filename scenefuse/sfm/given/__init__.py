"""Cameras that another program found, in the place of mapping."""
