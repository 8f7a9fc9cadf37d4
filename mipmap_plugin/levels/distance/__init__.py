"""Levels by distance: each splat is merged only as far as the distance at which a viewer shows the level allows (`ladder`)."""
