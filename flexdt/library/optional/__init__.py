"""Optional packages: which extra brings one, and HDF5 files opened with h5py."""
