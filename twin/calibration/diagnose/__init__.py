"""What is wrong with calibration data, by name."""
