"""Functions of the Python library: data sets, geometries, scripts and simulated scans."""
