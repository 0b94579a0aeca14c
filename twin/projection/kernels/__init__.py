"""Compiled loops of the projectors, for the processor and for CUDA devices."""
