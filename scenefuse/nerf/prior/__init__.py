"""Stages 1 and 3: depth networks trained on the object's photos, then refined with the NeRF's depth maps."""
