"""Evidence-based completion of objects in large point clouds."""
