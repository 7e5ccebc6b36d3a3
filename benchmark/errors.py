"""Errors of the benchmark."""


class BenchmarkError(Exception):
    """The benchmark cannot go on as requested; the text says why."""
