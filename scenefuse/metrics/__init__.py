"""Metrics of registration and completion beside their nulls, and evaluation against the truth where it is known."""
