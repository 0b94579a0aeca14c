"""Named objects to scan: bead cuboids, the LEGO phantom, Shepp-Logan, meshes."""
