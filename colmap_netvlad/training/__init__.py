"""The training system of the paper: annotated scenes, sampling, losses, the training loop."""
