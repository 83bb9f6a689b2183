"""Metrics of registration and completion beside their nulls."""
