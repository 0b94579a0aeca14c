"""The thesis's experiments as pure computations: plans, runs, tables. Clients run them."""
