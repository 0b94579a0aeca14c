"""Whether the images of a scan fit its geometry, and what would explain that they do not."""
