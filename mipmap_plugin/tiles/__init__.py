"""One scene in tiles: a scene of any size is cut into parts, each of which is adapted as a job of its own; `run.adapt_in_tiles` does it all."""
