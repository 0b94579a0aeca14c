"""Geometry of an ordinary circular scan from its own projections, without a phantom."""
