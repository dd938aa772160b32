"""What every program needs and no photogrammetry: errors, files, progress, processes."""
