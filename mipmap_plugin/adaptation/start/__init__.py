"""What a run begins with: the closed form, merged splats and matched opacities."""
