"""Structure from motion: photos, features, matches, mapping, georeferencing, undistortion; gravity and fiducials."""
