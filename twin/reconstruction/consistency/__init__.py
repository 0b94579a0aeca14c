"""Agreement of a scan's images with its geometry, and explanations of a contradiction."""
