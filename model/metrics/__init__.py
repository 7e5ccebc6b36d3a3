"""How good forecasts are: pure functions over arrays, used by training, benchmark and track memory.

Everywhere: float64 numpy, m and s, ground frame; N instances (agent and time), K modes, S samples, T steps
of 0.5 s, step t (from 1) at index t − 1. What cannot be known because an input is not finite is NaN, also
where the answer would be yes or no (1 or 0 then); ``aggregate`` keeps NaN out of the means and counts it.
"""
