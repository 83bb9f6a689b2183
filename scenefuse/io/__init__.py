"""Files: point clouds, depth and normal maps, pictures, masks, tables, settings."""
