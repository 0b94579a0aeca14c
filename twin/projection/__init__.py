"""X-ray projection: exact path lengths through voxel volumes and analytic shapes."""
