"""Bead spots in radiographs: found, measured, and measured again where they are expected."""
