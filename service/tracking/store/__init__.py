"""Stores of the track memory: this process or Redis, behind one interface."""
