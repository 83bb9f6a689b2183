"""Undistorted photos, and dense stereo: view selection, plane sweep, depth maps, dense cloud."""
