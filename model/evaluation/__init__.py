"""Evaluation of whole models on recorded data, without a server.

``pairs``, ``results``, ``tables`` and ``published`` load no networks; the benchmark shares them.
"""
