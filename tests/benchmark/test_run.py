"""Whole benchmarks against the real server."""

import asyncio
import math
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmark.archive import Archive
from benchmark.context import ContextSettings
from benchmark.errors import BenchmarkError
from benchmark.evaluate import CONSISTENCY, Evaluated
from benchmark.explanations import FILE, ExplanationSettings
from benchmark.models import BASELINES, select
from benchmark.replay import Replayed
from benchmark.results import BenchmarkResults, Instances
from benchmark.run import IN_PROCESS, Benchmark, Endpoint, Progress, listed_models, run_benchmark
from benchmark.tables import markdown
from cab.forecast.v1.model_service_pb2 import Model
from cab.forecast.v1.prediction_service_pb2 import FORECAST_STATUS_FALLBACK
from cab_forecast import AsyncClient
from cab_forecast.explanations import PARTS
from model.evaluation import selection
from model.evaluation.run import Evaluation
from model.features.spec import Frame
from model.forecaster import Forecaster, Protocol
from model.metrics.density import DRAWS
from model.metrics.oracle import ORACLE, PHYSICS
from model.metrics.pairs import Sampling
from model.networks.config import NetworkConfig
from service.server import Server
from tests.benchmark.scenes import PAIRS, READER
from tests.model.evaluation.builders import checkpoints, save
from tests.service.servers import in_thread, settings

SAMPLES = 20


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Checkpoints of random weights, in both frames."""
    folder = checkpoints(tmp_path_factory.mktemp("models"))
    save(folder / "trajectron", "trajectron", NetworkConfig(frame=Frame.AGENT, far_map=True, modes=3))
    return folder


@pytest.fixture(scope="module")
def server(models: Path) -> Iterator[Server]:
    """A server with them and the baselines."""
    with in_thread(settings(models=models, allow_paper_protocol=True)) as running:
        yield running


def made(folder: Path, protocol: Protocol = Protocol.CAUSAL, limit: int | None = None) -> Benchmark:
    """A benchmark on made-up scenes."""
    return Benchmark("made", READER, "some", protocol, folder, Sampling(SAMPLES, DRAWS), limit=limit)


def ask(whole: Benchmark, address: str, *names: str) -> dict[str, Model]:
    """Models whose forecasts without a saved answer were requested."""

    async def go() -> dict[str, Model]:
        async with AsyncClient(address, timeout=30, retries=1000) as client:
            chosen = select(await listed_models(client), whole.protocol, names)
            await whole.replay(client, Endpoint(address, None, 4, 30), chosen)
            return chosen

    return asyncio.run(go())


def evaluated(
    whole: Benchmark, chosen: dict[str, Model], processes: int = 1
) -> tuple[BenchmarkResults, Evaluated]:
    """Evaluation of the saved answers."""
    return whole.evaluate(chosen, processes)


def same(one: BenchmarkResults, other: BenchmarkResults) -> None:
    """Compare everything but durations."""
    for left, right in zip(one.models, other.models, strict=True):
        assert left.key == right.key
        np.testing.assert_equal(dict(left.metrics), dict(right.metrics))
        assert (left.statuses, left.instants) == (right.statuses, right.instants)


@pytest.mark.parametrize("protocol", Protocol)
@pytest.mark.parametrize("transport", ["grpc", "http"])
def test_online_equals_offline(
    tmp_path: Path, server: Server, models: Path, protocol: Protocol, transport: str
) -> None:
    address = server.grpc_address if transport == "grpc" else server.http_address
    whole = made(tmp_path, protocol)
    chosen = ask(whole, f"{transport}://{address}")
    results, _ = evaluated(whole, chosen)
    assert results.missing == 0
    assert {model.name for model in results.models} >= {*BASELINES, ORACLE, "cab"}
    offline = Evaluation(
        selection.select(models, protocol), "made", READER, "some", protocol, tmp_path / "cache", SAMPLES
    )(lambda *_: None, lambda _: None)
    assert results.pairs == offline.pairs == PAIRS
    rows = {row.key: row for row in offline.models}
    assert {model.key for model in results.models} == set(rows)
    for model in results.models:
        for name, value in rows[model.key].metrics.items():
            approx = pytest.approx(value, rel=1e-4, abs=1e-4, nan_ok=True)
            assert model.metrics[name] == approx, (model.key, name)


def test_what_a_run_tells(tmp_path: Path, server: Server) -> None:
    whole = made(tmp_path)
    results, found = evaluated(whole, ask(whole, f"grpc://{server.grpc_address}"))
    by_name = {model.name: model for model in results.models}
    cab, kalman, oracle = by_name["cab"], by_name["kalman"], by_name[ORACLE]
    assert sum(cab.statuses.values()) == PAIRS
    assert cab.statuses["SHORT_HISTORY"] > 0
    assert (cab.protocol, kalman.protocol) == ("causal", "any")
    assert cab.latency is not None
    assert 0 < cab.latency.inference_p50_s < cab.latency.p50_s <= cab.latency.p99_s < 30
    assert cab.latency.calls == sum(len(scene.calls) for scene in whole.scenes)
    assert cab.instants == oracle.instants > 0
    physics = [by_name[name].metrics["ade_ml_6s_m"] for name in PHYSICS]
    assert oracle.metrics["ade_ml_6s_m"] < min(physics)
    # The hardest are those that Kalman misses most
    assert found.mismatch_m is not None
    assert kalman.metrics["fde_hardest_1_m"] == found.mismatch_m.max()
    assert kalman.metrics["fde_hardest_all_m"] == pytest.approx(kalman.metrics["fde_ml_6s_m"])
    assert found.instances.figures["cab@1.0.0/fde_ml_6s_m"].mean() == pytest.approx(
        cab.metrics["fde_ml_6s_m"]
    )
    cases = whole.hard_cases([cab.key], found.mismatch_m)
    assert cases[0].mismatch_m == found.mismatch_m.max()
    assert [case.mismatch_m for case in cases] == sorted((case.mismatch_m for case in cases), reverse=True)
    assert len({(case.scene, case.agent) for case in cases}) == len(cases) == 6
    hardest = int(found.mismatch_m.argmax())
    scene = next(scene for scene in whole.scenes if scene.first <= hardest < scene.first + len(scene.pairs))
    np.testing.assert_array_equal(cases[0].truth, scene.truth()[hardest - scene.first])
    np.testing.assert_array_equal(cases[0].history[-1], scene.origin()[hardest - scene.first])


def test_what_is_saved_gives_the_same_again(tmp_path: Path, server: Server) -> None:
    whole = made(tmp_path)
    results, _ = evaluated(whole, ask(whole, f"grpc://{server.grpc_address}"))
    again = made(tmp_path)
    same(results, evaluated(again, again.saved_models(), processes=2)[0])
    some, _ = evaluated(again, again.saved_models(["kalman"]))
    assert [model.key for model in some.models] == ["kalman@1.0.0"]


def test_another_seed_draws_others(tmp_path: Path, server: Server) -> None:
    whole = made(tmp_path)
    chosen = ask(whole, f"grpc://{server.grpc_address}", "cab")
    other = replace(whole, sampling=replace(whole.sampling, seed=1))
    first, second = (evaluated(one, chosen)[0].models[0].metrics for one in (whole, other))
    assert first["fde_ml_6s_m"] == second["fde_ml_6s_m"]
    assert first["fde_f_6s_m"] != second["fde_f_6s_m"]


def test_a_server_that_restarts_midway_loses_nothing(tmp_path: Path, models: Path) -> None:
    whole = made(tmp_path)
    halfway = threading.Event()

    async def go(endpoint: str) -> tuple[dict[str, Model], Replayed]:
        asked = 0
        chosen: dict[str, Model] = {}

        def tick(done: int) -> None:
            nonlocal asked
            asked += done
            if asked > len(chosen) * whole.forecasts // 3:
                halfway.set()

        async with AsyncClient(endpoint, timeout=60, retries=1000) as client:
            chosen |= select(await listed_models(client), whole.protocol)
            return chosen, await whole.replay(client, Endpoint(endpoint, None, 4, 60), chosen, tick)

    with ThreadPoolExecutor(1) as pool:
        with in_thread(settings(models=models)) as first:
            address = first.grpc_address
            asking = pool.submit(asyncio.run, go(f"grpc://{address}"))
            assert halfway.wait(60)
        assert not asking.done()  # or the test has shown nothing
        with in_thread(settings(models=models, grpc=address)):
            chosen, replayed = asking.result(120)
    assert not replayed.refused
    results, _ = evaluated(whole, chosen)
    assert results.missing == 0
    assert all(sum(model.statuses.values()) == PAIRS for model in results.models if model.version)


def test_answers_of_another_run_are_refused(tmp_path: Path, server: Server) -> None:
    ask(made(tmp_path, limit=5), f"grpc://{server.grpc_address}", "kalman")
    with pytest.raises(BenchmarkError, match="holds answers of another run: limit was 5, is none"):
        made(tmp_path).saved_models()
    with pytest.raises(BenchmarkError, match="protocol was causal, is paper"):
        made(tmp_path, Protocol.PAPER, limit=5).saved_models()


def test_an_instance_without_an_answer_is_missed(tmp_path: Path, server: Server) -> None:
    whole = made(tmp_path)
    chosen = ask(whole, f"grpc://{server.grpc_address}", "kalman", "cab")
    lost = whole.scenes[1].calls[0]
    with Archive(tmp_path) as archive:
        archive._file.execute("DELETE FROM answers WHERE scene = 'scene-2' AND frame = ?", (lost.frame,))
    results, _ = evaluated(whole, chosen)
    assert results.missing == 2 * len(lost.due) > 0
    assert results.models[0].lost == 0
    assert results.models[0].statuses["MISSING"] == len(lost.due)
    assert np.isfinite(results.models[0].metrics["fde_ml_6s_m"])


def test_a_forecast_for_dispersion_alone_is_missed_too(tmp_path: Path, server: Server) -> None:
    whole = made(tmp_path)
    chosen = ask(whole, f"grpc://{server.grpc_address}", "kalman")
    whole_instants = evaluated(whole, chosen)[0].models[0].instants
    lost = whole.scenes[0].calls[-1]
    assert not lost.due
    with Archive(tmp_path) as archive:
        archive._file.execute("DELETE FROM answers WHERE scene = 'scene-1' AND frame = ?", (12,))
        archive._file.execute("DELETE FROM answers WHERE scene = 'scene-1' AND frame = ?", (lost.frame,))
    (kalman,) = evaluated(whole, chosen)[0].models
    assert kalman.statuses.get("MISSING", 0) == 0
    assert kalman.missing == kalman.lost > len(lost.tracks)
    assert kalman.instants < whole_instants


def test_the_fallbacks_of_a_model_are_said(tmp_path: Path, server: Server) -> None:
    """The saved responses are changed as if every pair had been a fallback."""
    whole = made(tmp_path)
    chosen = ask(whole, f"grpc://{server.grpc_address}", "kalman")
    with Archive(tmp_path) as archive:
        for scene in whole.scenes:
            for frame, answer in list(archive.answers("kalman@1.0.0", scene.record.name)):
                (call,) = (call for call in scene.calls if call.frame == frame)
                for forecast in answer.response.forecasts:
                    forecast.status = FORECAST_STATUS_FALLBACK
                archive.add("kalman@1.0.0", scene.record.name, call, answer)
    results, _ = evaluated(whole, chosen)
    assert results.models[0].fallbacks == PAIRS
    assert f"kalman@1.0.0 ({PAIRS} of {PAIRS} by a fallback)" in markdown(results)


def test_nobody_at_the_endpoint(tmp_path: Path) -> None:
    with pytest.raises(BenchmarkError, match="does not answer"):
        asyncio.run(_list("grpc://127.0.0.1:1"))


async def _list(endpoint: str) -> list[Model]:
    async with AsyncClient(endpoint, timeout=1, retries=0) as client:
        return await listed_models(client)


class Recorder(Progress):
    """Keeps what it receives."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.steps: dict[str, int] = {}
        self.totals: dict[str, int] = {}

    def note(self, text: str) -> None:
        self.notes.append(text)

    @contextmanager
    def task(self, name: str, total: int | None = None, unit: str = "") -> Iterator[Callable[[int], None]]:
        self.totals[name], self.steps[name] = total or 0, 0

        def tick(steps: int) -> None:
            self.steps[name] += steps

        yield tick


FILES = {"answers.sqlite", "results.json", "tables.md", "instances.npz", "benchmark.yml", "report.html"}


def test_one_call_runs_a_whole_benchmark_in_process(tmp_path: Path, server: Server, models: Path) -> None:
    """Its figures are those of an endpoint with the same models."""
    chosen = selection.select(models, Protocol.CAUSAL)
    forecasters = [*chosen.baselines, *(one.forecaster for one in chosen.learned)]
    progress = Recorder()
    local = run_benchmark(made(tmp_path / "local"), forecasters, tmp_path / "local", progress=progress)
    address = Endpoint(f"grpc://{server.grpc_address}", concurrency=4, timeout=30)
    remote = run_benchmark(made(tmp_path / "remote"), address, tmp_path / "remote")
    for folder, run in (("local", local), ("remote", remote)):
        submissions = {f"submission-{model.key}.json" for model in run.results.models if model.version}
        assert {file.name for file in (tmp_path / folder).iterdir()} == FILES | submissions
        assert {file.name for file in run.files} == {"report.html"} | submissions
    assert local.results.endpoint == IN_PROCESS
    assert local.results.missing == remote.results.missing == 0
    assert {one.key for one in local.results.models} == {one.key for one in remote.results.models}
    theirs = {one.key: one for one in remote.results.models}
    held = Instances.read(tmp_path / "local", local.results.pairs)
    for model in local.results.models:
        for name in (*CONSISTENCY, "fde_hardest_3_m", "fde_merged_6s_m", "nll"):
            ratio = held.ratio(model.key, name)
            assert (ratio is None) == (name not in model.metrics), name
            if ratio is not None:
                known = ratio.sums.sum() / ratio.divisors.sum()
                assert known == pytest.approx(model.metrics[name], nan_ok=True), name
        other = theirs[model.key]
        assert (model.protocol, model.trained_on) == (other.protocol, other.trained_on)
        assert (model.statuses, model.instants) == (other.statuses, other.instants)
        assert model.metrics.keys() == other.metrics.keys()
        for name, value in model.metrics.items():
            approx = pytest.approx(other.metrics[name], rel=1e-4, abs=1e-4, nan_ok=True)
            assert value == approx, (model.key, name)
    assert progress.steps == progress.totals
    assert set(progress.steps) == {"reading the data", f"running {len(forecasters)} models", "evaluating"}
    assert any(note.startswith("requested ") for note in progress.notes)


def test_the_use_of_the_context_is_the_same_through_an_endpoint(
    tmp_path: Path, server: Server, models: Path
) -> None:
    names = ["cab", "kalman", "constant-velocity-yaw"]
    chosen = selection.select(models, Protocol.CAUSAL, names)
    forecasters = [*chosen.baselines, *(one.forecaster for one in chosen.learned)]
    context = ContextSettings(donors=1, no_context="constant-velocity-yaw")
    address = Endpoint(f"grpc://{server.grpc_address}", concurrency=4, timeout=30)
    sources: list[Sequence[Forecaster] | Endpoint] = [forecasters, address]
    found = []
    for number, source in enumerate(sources):
        folder = tmp_path / str(number)
        whole = replace(made(folder, limit=40), sampling=Sampling(0, 0), consistency=False, context=context)
        results = run_benchmark(whole, source, folder, names=names).results
        assert results.missing == 0
        found.append({model.key: model.context for model in results.models})
    local, remote = found
    assert local.keys() == remote.keys()
    assert local["cab@1.0.0"]["all"]["map_advantage_m"].pairs > 0
    assert "hardest 10 %" in local["cab@1.0.0"]
    for key, subsets in local.items():
        for subset, measures in subsets.items():
            assert measures.keys() == remote[key][subset].keys()
            for name, one in measures.items():
                other = remote[key][subset][name]
                assert one.pairs == other.pairs
                assert (one.value, one.low, one.high) == pytest.approx(
                    (other.value, other.low, other.high), rel=1e-3, abs=1e-3, nan_ok=True
                ), (key, subset, name)


def test_saved_answers_of_this_process_are_not_made_again(tmp_path: Path, models: Path) -> None:
    kalman = selection.select(models, Protocol.CAUSAL, ["kalman"]).baselines
    first = run_benchmark(made(tmp_path / "run"), kalman, tmp_path / "run")
    progress = Recorder()
    second = run_benchmark(made(tmp_path / "run"), kalman, tmp_path / "again", progress=progress)
    assert any(note.startswith("requested 0 forecasts") for note in progress.notes)
    third = run_benchmark(made(tmp_path / "run"), None, tmp_path / "saved", names=["kalman"], processes=2)
    assert first.results == second.results == third.results
    with pytest.raises(BenchmarkError, match="this process has no model 'cab'; it has kalman"):
        run_benchmark(made(tmp_path / "run"), kalman, tmp_path / "run", names=["cab"])


def test_explanations_of_some_pairs(tmp_path: Path, server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    # Forwards of other sizes round differently, and the sizes of parts follow from the machine's speed
    monkeypatch.setattr("service.predict.batcher._SPARE_SECONDS", math.inf)
    address = Endpoint(f"grpc://{server.grpc_address}", concurrency=4, timeout=30)
    whole = replace(
        made(tmp_path, limit=40),
        sampling=Sampling(0, 0),
        consistency=False,
        explain=ExplanationSettings(pairs=6, baseline="null_context"),
    )
    names = ["cab", "kalman"]
    results = run_benchmark(whole, address, tmp_path, names=names).results
    by_model = {model.key: model.explanation for model in results.models}
    cab, kalman = by_model["cab@1.0.0"], by_model["kalman@1.0.0"]
    assert {part: one.pairs for part, one in cab.items()} == dict.fromkeys(PARTS, 6)
    assert cab["map"].value or cab["neighbors"].value
    assert kalman["state"].value > 0
    assert (kalman["map"].value, kalman["neighbors"].value) == (0, 0)
    assert "10. What the forecasts owe to state" in markdown(results)
    assert BenchmarkResults.read(tmp_path) == results
    # A run that was stopped goes on; what was not written to its end is asked again
    file = tmp_path / FILE
    lines = file.read_text().splitlines(keepends=True)
    assert len(lines) == 1 + 2 * 6
    file.write_text("".join(lines[:5]) + lines[5][:30])
    again = run_benchmark(whole, address, tmp_path, names=names).results
    assert {model.key: model.explanation for model in again.models} == by_model
    assert len(file.read_text().splitlines()) == 1 + 2 * 6
    other = replace(whole, explain=ExplanationSettings(pairs=5, baseline="null_context"))
    with pytest.raises(BenchmarkError, match="another run"):
        run_benchmark(other, address, tmp_path, names=names)
