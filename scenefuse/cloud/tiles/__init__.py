"""Clouds of any size on disk: read and written in parts, and read by place."""
