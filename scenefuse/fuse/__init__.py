"""Registered objects added to the scene, each by itself, then all of them in the completed scene."""
