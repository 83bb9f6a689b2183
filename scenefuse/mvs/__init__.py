"""Dense stereo: view selection, plane sweep, depth maps, their consistency, dense cloud; visual hull."""
