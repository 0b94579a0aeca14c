"""Real, public data from outside this project, compared with their published answers."""
