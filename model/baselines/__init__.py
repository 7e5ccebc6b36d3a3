"""Physics and Kalman baselines, and the uncertainty that they state."""
