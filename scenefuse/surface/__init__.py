"""What is handed over: a surface of each completed object, its drawings, and the cameras of both sides."""
