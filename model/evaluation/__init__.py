"""Judges whole models on recorded data, without a server."""
