"""The mathematics of one image in readable torch, and what viewers do differently, as data."""
