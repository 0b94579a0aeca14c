"""The geometry of a scan: frames and signs, poses, offsets, and cone_vec rows as a value."""

from flexdt.twin.geometry.cone_vec import ConeVec

__all__ = ["ConeVec"]
