"""What is handed over: a surface of each completed object, its drawings, tiles and cameras."""
