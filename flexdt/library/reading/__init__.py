"""Read data sets: folders of this package and of scanners, and files of other programs."""
