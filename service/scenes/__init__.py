"""Live scenes: which there are, and what watchers get of their forecasts."""
