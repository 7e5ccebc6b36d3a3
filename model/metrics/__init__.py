"""Metrics of forecasts: pure functions over arrays, used by training, benchmark and track memory.

Conventions: float64 numpy, m and s, ground frame; N instances (agent and time), K modes, S samples, T steps
of 0.5 s, step t (from 1) at index t − 1. Values that are undefined because an input is not finite are NaN, so
that yes and no are 1 and 0; ``aggregate`` keeps NaN out of the means and counts them.
"""
