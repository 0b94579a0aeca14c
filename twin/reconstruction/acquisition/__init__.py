"""The recording of a scan, before any reconstruction.

Its trajectory, upright panels, the object beyond their edges, and the voxels that its
views cover.
"""
