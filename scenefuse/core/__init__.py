"""What every part shares: stages, settings, projects, transforms, fingerprints, checkpoints."""
