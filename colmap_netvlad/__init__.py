"""Deep image pair retrieval for COLMAP on drone flights."""

__version__ = "0.1.0"
