"""The thesis's experiments: plans, runs on several processes, tables and reports."""
