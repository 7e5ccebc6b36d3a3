"""What the track memory tells: dispersion, convergence-to-range, displacement error, live."""
