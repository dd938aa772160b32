"""COLMAP's database and calls into pycolmap: the only room that knows COLMAP's tables."""
