"""CTSimU scenarios to images: read the scenario (`ctsimu_scan`), make its images
(`scenario`)."""
