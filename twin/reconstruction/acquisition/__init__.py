"""What a scan recorded, before anything is reconstructed of it.

Its trajectory, panels that stand upright, what lies beyond their edges, and the voxels that its
views cover.
"""
