"""Many checkpoints at many scales: jobs, and the engines that run them in this process, in several, or on a cluster."""
