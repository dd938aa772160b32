"""Files of photos: what is in them before anything is computed."""
