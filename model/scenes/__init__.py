"""Observed scenes: observations, their resampling to the grid, rasters and map patches."""
