"""The interactive view: what its page shows, and how it is drawn."""
