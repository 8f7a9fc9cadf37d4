"""gsplat's checkpoints."""
