"""Readers of Varian's scans: Scan.xml with XIM images."""
