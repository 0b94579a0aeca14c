"""Balls and beads compared: how a phantom stands, and in how many ways it may."""
