"""Readers of map files, one module a format."""
