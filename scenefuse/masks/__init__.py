"""Masks of the object in its photos: prompts, GrabCut or SAM 2 or supplied files, agreement with the visual hull."""
