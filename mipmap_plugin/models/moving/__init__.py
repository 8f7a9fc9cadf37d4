"""Moving scenes: Deformable-3D-Gaussians and 4DGaussians."""
