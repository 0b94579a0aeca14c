"""The scanner, pure: frames, geometry, machine, motion, script, projection, calibration.

Nothing below this package opens a socket, a thread, a clock or a file other than its own
read-only package data. Time and randomness are arguments.
"""
