"""The thesis's experiments run on several processes, and their reports."""
