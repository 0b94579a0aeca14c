"""From poses to images: the hidden truth, projections, counts."""
