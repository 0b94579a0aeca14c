"""Meshes of the scanner, of its cabinet and of the bodies that its collisions are found
with."""
