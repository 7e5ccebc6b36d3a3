"""Scene rasters that calls name by their digest: kept decoded in the process, and encoded in Redis."""
