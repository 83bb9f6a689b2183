"""What was surveyed: control and check points, positions of photos with their accuracy, known lengths."""
