"""Image pairs -> verified matches in the database."""
