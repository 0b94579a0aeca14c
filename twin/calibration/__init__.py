"""Geometric calibration from a bead phantom."""
