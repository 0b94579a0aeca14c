"""Calibration of data sets: folders in, reports and corrections out."""
