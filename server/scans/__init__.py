"""Scans: submitted, checked, queued, run, paused, resumed."""
