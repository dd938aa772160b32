"""A rendered drone flight with known camera poses, and the whole pipeline run on it."""
