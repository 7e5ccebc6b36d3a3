"""The track memory in Redis: single, Sentinel or Cluster."""
