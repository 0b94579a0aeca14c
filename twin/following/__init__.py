"""A real machine followed by its messages: what is known of it, and what is
not as predicted."""
