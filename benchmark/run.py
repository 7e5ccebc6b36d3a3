"""A whole benchmark: what ``cab-forecast benchmark`` does."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path

from benchmark import BenchmarkError
from benchmark.answers import read_answers
from benchmark.archive import Archive
from benchmark.hard import HardCase, hard_case, shown_cases
from benchmark.judge import Judged, judge
from benchmark.models import choose
from benchmark.plan import PlannedScene, digest, plan_scenes
from benchmark.replay import Replay, Replayed
from benchmark.results import Results
from benchmark.score import Judging
from cab.forecast.v1.model_service_pb2 import Model
from cab_forecast import AsyncClient, ForecastError
from model.arrays import Floats
from model.data.scenes import Reader
from model.forecaster import Protocol


@dataclass(frozen=True)
class Benchmark:
    """What is asked of an endpoint, and how its answers are judged."""

    kind: str
    """Of the data set."""
    reader: Reader
    split: str
    protocol: Protocol
    """Of the inputs."""
    folder: Path
    """Of the answers."""
    judging: Judging
    limit: int | None = None
    """How many of the first pairs; None: all."""

    @cached_property
    def scenes(self) -> list[PlannedScene]:
        """All that is asked.

        Raises:
            DataError: the data is bad, or the split is unknown or has no pairs.
        """
        return list(
            plan_scenes(self.reader, self.split, consistency=self.judging.consistency, limit=self.limit)
        )

    @cached_property
    def plan(self) -> str:
        """Digest of what is asked."""
        return digest(self.scenes)

    @property
    def pairs(self) -> int:
        """How many pairs there are."""
        return sum(len(scene.pairs) for scene in self.scenes)

    def replay(self, models: Mapping[str, Model], concurrency: int, timeout: float) -> Replay:
        """The calls to an endpoint; arguments as ``Replay``."""
        return Replay(self.scenes, models, self.protocol, concurrency, timeout)

    async def ask(
        self, client: AsyncClient, endpoint: str, replay: Replay, tick: Callable[[int], None]
    ) -> Replayed:
        """Asks whatever has no answer yet.

        Args:
            client: of the endpoint.
            endpoint: its name, for the record.
            replay: of this benchmark.
            tick: told of every call how many forecasts it brought.

        Raises:
            BenchmarkError: the folder has answers of something else, or the endpoint does not answer.
        """
        with Archive(self.folder) as archive:
            archive.bind(self._facts())
            archive.note("endpoint", endpoint)
            archive.note("concurrency", str(replay.concurrency))
            for name, model in replay.models.items():
                archive.register(name, model)
            return await replay.run(client, archive, tick)

    def saved_models(self, names: Sequence[str] = ()) -> dict[str, Model]:
        """Models whose answers are saved, by ``name@version``.

        Args:
            names: ``name`` or ``name@version`` of those that are wanted; empty: all.

        Raises:
            BenchmarkError: there are no answers, or to something else, or none of a name.
        """
        with Archive(self.folder, read_only=True) as archive:
            archive.check(self._facts())
            saved = archive.models()
        if not saved:
            raise BenchmarkError(f"{self.folder}: there are no saved answers")
        return choose(list(saved.values()), self.protocol, names, str(self.folder)) if names else saved

    def judge(
        self, models: Mapping[str, Model], processes: int, tick: Callable[[int], None]
    ) -> tuple[Results, Judged]:
        """Judges the saved answers.

        Args:
            models: by ``name@version``.
            processes: that judge.
            tick: told how many pairs are done.

        Returns:
            All figures; and those of each pair.
        """
        judged = judge(self.folder, self.scenes, models, self.judging, processes, tick)
        with Archive(self.folder, read_only=True) as archive:
            facts, refusals = archive.facts(), archive.refusals()
        results = Results(
            data=self.kind,
            split=self.split,
            protocol=self.protocol,
            pairs=self.pairs,
            limit=None if self.limit is None or self.limit > self.pairs else self.limit,
            consistency=self.judging.consistency,
            samples=self.judging.samples,
            draws=self.judging.draws,
            seed=self.judging.seed,
            plan=self.plan,
            endpoint=facts.get("endpoint", ""),
            concurrency=int(facts.get("concurrency", 0)),
            version=version("cab-forecast"),
            models=judged.models,
            refusals=tuple(
                f"{one.model}, {one.scene}, frame {one.frame}: {one.why}"
                for one in refusals
                if one.model in models
            ),
        )
        return results, judged

    def hard_cases(self, models: Sequence[str], mismatch_m: Floats) -> list[HardCase]:
        """The hardest pairs with what some models made of them, for pictures.

        Args:
            models: ``name@version``.
            mismatch_m: [pairs], m, of the Kalman filter.
        """
        cases = []
        with Archive(self.folder, read_only=True) as archive:
            for scene, number in shown_cases(self.scenes, mismatch_m):
                mixtures = {}
                for model in models:
                    answers = read_answers(archive, model, scene)
                    if answers.mixture is not None and number in answers.instances:
                        row = int(answers.instances.searchsorted(number))
                        mixtures[model] = answers.mixture[row : row + 1]
                cases.append(hard_case(scene, number, float(mismatch_m[scene.first + number]), mixtures))
        return cases

    def _facts(self) -> dict[str, str]:
        """What answers must be to."""
        return {
            "data": self.kind,
            "split": self.split,
            "protocol": self.protocol.value,
            "limit": str(self.limit or "none"),
            "consistency": "yes" if self.judging.consistency else "no",
            "plan": self.plan[:16],
        }


async def listed_models(client: AsyncClient) -> list[Model]:
    """What the endpoint lists.

    Raises:
        BenchmarkError: it does not answer.
    """
    try:
        return await client.list_models()
    except ForecastError as error:
        raise BenchmarkError(f"the endpoint does not answer: {error}") from error
