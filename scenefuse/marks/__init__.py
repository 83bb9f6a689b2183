"""A person's marks: clicks in photos, labels, points, known lengths, the tables that hold them, and their checks."""
