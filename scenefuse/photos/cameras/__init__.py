"""Cameras that another program found: readers of their formats."""
