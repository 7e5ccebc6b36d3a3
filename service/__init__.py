"""The forecasting server: transports call predict, predict calls tracking."""
