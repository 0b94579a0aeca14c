"""Commands about a scanner: its state and motion, scripts and jobs, machine files and phantoms."""
