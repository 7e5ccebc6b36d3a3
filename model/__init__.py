"""Motion forecasting without a server: scenes, states, networks, mixtures, physics, checkpoints."""
