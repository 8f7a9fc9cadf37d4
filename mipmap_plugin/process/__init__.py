"""What this process has once for all of its work: its memory, its threads, and the modes of the libraries that it loads."""
