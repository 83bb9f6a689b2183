"""The rendered capture with known truth: meshes, textures, cameras, photos, simulated clicks; and its evaluation."""
