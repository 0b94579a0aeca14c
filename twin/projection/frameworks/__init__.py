"""Projector and adjoint as operators of other libraries, one module for each library."""
