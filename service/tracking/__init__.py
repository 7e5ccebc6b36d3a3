"""Track memory: what it tells of forecasts, and the stores it is kept in."""
