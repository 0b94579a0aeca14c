"""Scripts and poses simulated on a virtual clock: plans, and what the beam sees in them."""
