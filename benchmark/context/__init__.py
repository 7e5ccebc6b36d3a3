"""Does a forecast use its context? Forecasts with maps and neighbours of other scenes, and what they tell."""

from benchmark.context.cases import ContextSettings
from benchmark.context.run import ContextBenchmark

__all__ = ["ContextBenchmark", "ContextSettings"]
