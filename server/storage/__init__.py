"""A twin server's files: its state, samples, corrections and data sets."""
