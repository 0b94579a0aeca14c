"""The scanner in 3-D: viser's scene of a state of the twin."""
