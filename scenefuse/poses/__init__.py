"""Camera poses without structure from motion: correspondences, scales of pairs, pose graph, bundle adjustment."""
