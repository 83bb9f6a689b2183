"""What every part shares: stages, settings, transforms, fingerprints, checkpoints. Standard library and NumPy."""
