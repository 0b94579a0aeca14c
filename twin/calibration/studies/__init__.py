"""The thesis's experiments as pure computations: plans, runs, tables. Running them is a client's."""
