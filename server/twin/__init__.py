"""The twin server: one scanner, its clients, and what they subscribe to."""
