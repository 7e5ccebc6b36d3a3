"""gRPC: the contract's services, health and reflection."""
