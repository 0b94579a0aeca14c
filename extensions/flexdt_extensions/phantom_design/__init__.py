"""Phantoms designed for least uncertainty in planned scans."""
