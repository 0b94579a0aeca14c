"""The library: what a program does with data sets, geometries, scripts and simulated scans."""
