"""REST and gRPC transports. They decode requests, call the pipeline, and encode responses and errors."""
