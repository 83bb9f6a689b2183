"""Point clouds: in memory and on disk, all formats, coordinate systems, tiles of large ones, import."""
