"""The mathematics of splatting one image, in readable torch, and the conventions of viewers, as data."""
