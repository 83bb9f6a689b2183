"""Masks from clicks in one photo or a few, carried on to all others."""
