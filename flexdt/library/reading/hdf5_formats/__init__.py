"""Formats in HDF5, NXtomo and Data Exchange, and what they share."""
