"""Algorithm 1 of Mipmap-GS: optimizer steps, density control, validation and resuming."""
