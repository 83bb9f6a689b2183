"""Photos, frames of videos, pictures, COLMAP models and workspaces, positions, posed photos of other programs."""
