"""The pose that makes the scene's points most likely, as noisy samples of the object, and how certain it is."""
