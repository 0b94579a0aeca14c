"""Filtered backprojection of Feldkamp, Davis and Kress, step by step."""
