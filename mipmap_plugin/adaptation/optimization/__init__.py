"""Algorithm 1 of Mipmap-GS, and what carries it: steps, density control, validation, resuming."""
