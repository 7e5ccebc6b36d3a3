"""Shapley values of a benchmark's models: explanations of some of its pairs, and their means.

The same pairs are explained of all models, through the endpoint. Explanations are kept as they arrive, a line
of JSON each, so that a run that was stopped goes on where it was.
"""

import asyncio
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np
from google.protobuf import json_format

from benchmark.bootstrap import mean_interval
from benchmark.errors import BenchmarkError
from benchmark.plan import Call, PlannedScene
from benchmark.requests import SceneRequests
from benchmark.results import BenchmarkResults, Estimate, ExplanationRun
from cab.forecast.v1.explanation_service_pb2 import AgentExplanation, ExplainRequest
from cab.forecast.v1.model_service_pb2 import Model
from cab_forecast import AsyncClient, ForecastError, as_explain_request, explain_options
from cab_forecast.explanations import PARTS, Baseline
from model.arrays import Floats, Ints
from model.forecaster import Protocol

FILE: Final = "explanations.jsonl"
"""Name of the file in the folder of a run."""
_Saved: TypeAlias = dict[tuple[str, int], AgentExplanation | None]
"""Explanations by model and number of the pair; None: the pair was not forecast."""
_CONCURRENCY: Final = 4
"""Calls at a time: a server works on one, and lets a few wait."""


@dataclass(frozen=True)
class ExplanationSettings:
    """Settings of the explanations of a benchmark."""

    pairs: int = 200
    """Maximum number of pairs, drawn at random."""
    baseline: Baseline = "donors"
    """Stand-in for absent parts of a scene."""


@dataclass(frozen=True)
class ExplanationBenchmark:
    """Explanations of some pairs of a benchmark."""

    folder: Path
    """Folder of the benchmark's answers."""
    scenes: Sequence[PlannedScene]
    protocol: Protocol
    seed: int
    properties: Mapping[str, str]
    """Properties of the benchmark, which its explanations are bound to."""
    settings: ExplanationSettings

    @cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """The pairs: index of the scene, and of the pair in it."""
        every = [
            (index, number) for index, scene in enumerate(self.scenes) for number in range(len(scene.pairs))
        ]
        drawn = np.random.default_rng(self.seed).permutation(len(every))[: self.settings.pairs]
        return [every[index] for index in sorted(drawn.tolist())]

    async def replay(
        self, client: AsyncClient, models: Mapping[str, Model], patience: float, tick: Callable[[int], None]
    ) -> None:
        """Request all explanations without a saved answer.

        Args:
            client: client of the endpoint.
            models: models by ``name@version``.
            patience: seconds for a call with its retries.
            tick: called with the number of explanations of each step, saved ones included.

        Raises:
            BenchmarkError: the folder holds explanations of another run, or the endpoint refuses.
        """
        saved = self._saved()
        total = len(self.pairs) * len(models)
        tick(sum(model in models for model, _ in saved))
        frames = max((model.history_frames for model in models.values()), default=1)
        work = self._work(saved, models, frames)
        file = self.folder / FILE
        self.folder.mkdir(parents=True, exist_ok=True)
        text = file.read_text(encoding="utf-8") if file.exists() else json.dumps(self._properties()) + "\n"
        file.write_text(
            text[: text.rfind("\n") + 1], encoding="utf-8"
        )  # without what was not written to its end
        with file.open("a", encoding="utf-8") as out:

            async def send() -> None:
                for model, number, request in work:
                    response = await client.explain(request, timeout=patience)
                    one = next((each for each in response.explanations if each.HasField("state")), None)
                    told = {} if one is None else json_format.MessageToDict(one)
                    out.write(json.dumps({"model": model, "pair": number, "explanation": told}) + "\n")
                    out.flush()
                    tick(1)

            senders = [asyncio.create_task(send()) for _ in range(min(_CONCURRENCY, total))]
            try:
                await asyncio.gather(*senders)
            except ForecastError as error:
                raise BenchmarkError(
                    f"no explanation: {error}; those so far are kept, run again to continue"
                ) from error
            finally:
                for sender in senders:
                    sender.cancel()
                await asyncio.gather(*senders, return_exceptions=True)

    def add_to(self, results: BenchmarkResults) -> BenchmarkResults:
        """Return results with the means of the saved explanations.

        Raises:
            BenchmarkError: there are no explanations, or those of another run.
        """
        saved = self._saved()
        if not saved:
            raise BenchmarkError(f"{self.folder / FILE}: there are no saved explanations")
        of = np.array([scene for scene, _ in self.pairs])
        models = tuple(
            replace(model, explanation=_means(self._values(saved, model.key), of)) for model in results.models
        )
        run = ExplanationRun(len(self.pairs), self.settings.baseline)
        return replace(results, models=models, explanation=run)

    def _values(self, saved: _Saved, model: str) -> Floats:
        """Return how much nearer each part brings the end points: [pairs, 3], NaN where not explained."""
        values = np.full((len(self.pairs), len(PARTS)), np.nan)
        for number in range(len(self.pairs)):
            one = saved.get((model, number))
            if one is not None:
                values[number] = [getattr(one, part).nearer for part in PARTS]
        return values

    def _work(
        self,
        saved: _Saved,
        models: Mapping[str, Model],
        frames: int,
    ) -> Iterator[tuple[str, int, ExplainRequest]]:
        options = explain_options(baseline=self.settings.baseline, seed=self.seed)
        last, requests = -1, None
        for number, (index, at) in enumerate(self.pairs):
            pending = [model for model in models if (model, number) not in saved]
            if not pending:
                continue
            scene = self.scenes[index]
            if requests is None or index != last:
                last, requests = index, SceneRequests(scene, self.protocol, frames)
            pair = scene.pairs[at]
            request = requests.request(Call(pair.frame, (pair.track,), frozenset()))
            for model in pending:
                request.model = model
                yield model, number, as_explain_request(request, options)

    def _saved(self) -> _Saved:
        """Return the saved explanations by model and number of the pair; None: the pair was not forecast.

        Raises:
            BenchmarkError: the file is of another run.
        """
        file = self.folder / FILE
        if not file.is_file():
            return {}
        found: _Saved = {}
        first, *lines = file.read_text(encoding="utf-8").split("\n")
        try:
            if json.loads(first) != self._properties():
                raise BenchmarkError(f"{file}: holds explanations of another run; use another folder")
            for line in lines[:-1]:  # what follows the last line's end was not written to its end
                entry = json.loads(line)
                told = entry["explanation"]
                message = json_format.ParseDict(told, AgentExplanation()) if told else None
                found[entry["model"], entry["pair"]] = message
        except (ValueError, KeyError, TypeError, json_format.ParseError) as error:
            raise BenchmarkError(f"{file}: cannot be read: {error}") from error
        return found

    def _properties(self) -> dict[str, str]:
        own = {"pairs": str(self.settings.pairs), "baseline": self.settings.baseline, "seed": str(self.seed)}
        return {**self.properties, **own}


def _means(values: Floats, scenes: Ints) -> dict[str, Estimate]:
    """Return the mean value of each part over the pairs that have it, with intervals by scenes."""
    known = np.isfinite(values).all(axis=1)
    values, scenes = values[known], scenes[known]
    if not len(values):
        return {}
    return {
        part: Estimate(float(column.mean()), *mean_interval(column, scenes), len(column))
        for part, column in zip(PARTS, values.T, strict=True)
    }
