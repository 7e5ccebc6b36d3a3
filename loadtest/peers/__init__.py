"""Other servers around the same network, compared with ours: ``python -m loadtest.peers``."""
