"""The scene's points around an object: by fiducials or by the votes of its masks, without the ground."""
