"""The scanner in 3-D: what viser draws for a state of the twin."""
