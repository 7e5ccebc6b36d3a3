"""Stores of the track memory: in-process or Redis, behind one interface."""
