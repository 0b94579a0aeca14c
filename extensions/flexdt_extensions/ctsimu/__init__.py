"""CTSimU scenarios to images: what is asked (`ctsimu_scan`), and the images (`scenario`)."""
