"""Stages 2 and 4: rays, field, training, rendered depth maps; and the object's cloud made of these."""
