"""Structure from motion: features, matches, mapping, lenses, spread, gravity, undistortion."""
