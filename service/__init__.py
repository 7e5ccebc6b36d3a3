"""The forecasting server: one transport-neutral core, REST and gRPC thin on top of it."""
