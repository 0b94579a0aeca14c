"""What touches what, and when: distances and sweeps over convex parts."""
