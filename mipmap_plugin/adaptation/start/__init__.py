"""The model that a run begins with: closed form, merged splats and matched opacities."""
