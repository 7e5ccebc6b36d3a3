"""Loads and measurements of a server that runs as users run it."""
