"""The compiled half of the CPU backend: the only place that imports numba."""
