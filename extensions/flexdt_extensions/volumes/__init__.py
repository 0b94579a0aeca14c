"""Volumes as OME-NGFF (Zarr), and FDK by workers that write them slab by slab."""
