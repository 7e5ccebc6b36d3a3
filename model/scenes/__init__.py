"""What was seen: observations, resampling to the grid, rasters and their patches."""
