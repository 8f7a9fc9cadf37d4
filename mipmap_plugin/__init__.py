"""Adapt trained Gaussian-splatting checkpoints to another zoom, without their training images and without retraining."""
