"""Compiled kernels: made ahead of their use, and kept in files."""
