"""The scanner as data: its description, its kinematics and its camera."""
