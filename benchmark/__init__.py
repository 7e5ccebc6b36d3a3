"""The benchmark: replays recorded scenes through a running endpoint, and judges its answers.

A client of the contract, as any other: what forecasts is behind the endpoint. Ben-Younes et al. 2022
(arXiv 2109.08048), section 4 and its tables.
"""


class BenchmarkError(Exception):
    """The benchmark cannot go on as asked; the text says why."""
