"""The peers: each module serves the network as a process of its own, in an environment of its own.

They import of this repository only what the network needs (``model``, ``loadtest.peers.arrays`` and
``loadtest.peers.network``), except for ``grpc_raw``, which imports the service.
"""
