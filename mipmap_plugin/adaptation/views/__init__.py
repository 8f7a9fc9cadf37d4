"""Views: those that are adapted to and those for validation, where they are, in which order they are used, and what they show."""
