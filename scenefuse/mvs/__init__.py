"""Dense stereo: view selection, plane sweep, depth maps, dense cloud."""
