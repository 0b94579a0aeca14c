"""Real, public data that nobody of this project made, against their published answers."""
