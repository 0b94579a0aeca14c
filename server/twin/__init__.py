"""The twin server: one scanner, its clients and their subscriptions."""
