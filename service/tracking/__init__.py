"""Track memory, and the consistency of forecasts computed from it."""
