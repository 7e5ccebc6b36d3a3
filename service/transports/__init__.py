"""Transports. Each is thin: it carries messages to the data plane and answers or errors back."""
