"""What values show in a notebook."""
