"""The geometry that explains bead tracks best, and how uncertain it is."""
