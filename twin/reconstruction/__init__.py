"""Volumes back from projections."""

from flexdt.twin.reconstruction.fdk import fdk, fdk_parts

__all__ = ["fdk", "fdk_parts"]
