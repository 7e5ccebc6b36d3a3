"""The benchmark: recorded scenes replayed through a running endpoint or in this process, and evaluated.

It is a client of the contract and does not know what forecasts behind an endpoint. Metrics and tables follow
Ben-Younes et al. 2022 (arXiv 2109.08048), section 4.
"""

from benchmark.errors import BenchmarkError
from benchmark.run import Benchmark, BenchmarkRun, Endpoint, Progress, run_benchmark

__all__ = ["Benchmark", "BenchmarkError", "BenchmarkRun", "Endpoint", "Progress", "run_benchmark"]
