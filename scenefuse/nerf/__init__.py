"""The four training stages: depth prior (`prior/`), rays, field, training, rendered maps; and the object's cloud."""
