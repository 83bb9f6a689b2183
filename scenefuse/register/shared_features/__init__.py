"""The alignment of the object's and the scene's sparse models from features that their photos share."""
