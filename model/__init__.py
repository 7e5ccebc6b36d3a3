"""Motion forecasting without a server: scenes, features, baselines, networks, training, metrics."""
