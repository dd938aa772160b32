"""A model in the world: frames, alignment, ground control, position priors."""
