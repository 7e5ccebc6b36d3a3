"""The public client of a cab-forecast server."""
