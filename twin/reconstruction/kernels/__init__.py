"""Compiled loops of the reconstructions, for the processor and for CUDA devices."""
