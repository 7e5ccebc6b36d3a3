"""Track memory in Redis: single server, Sentinel or Cluster."""
