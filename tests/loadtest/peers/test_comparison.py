"""Comparisons in a short form, with the peers that are installed."""

import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from loadtest.peers.__main__ import app
from loadtest.peers.arrays import unpack
from loadtest.peers.catalog import PEERS, interpreter
from loadtest.peers.codecs import Packed
from loadtest.peers.comparison import Options, compare
from loadtest.peers.network import Network, ServedModel
from loadtest.peers.prepared import PreparedRequests
from loadtest.peers.processes import running
from loadtest.peers.report import Comparisons
from loadtest.redis_servers import free_port
from loadtest.requests import made_up_requests

ROOT = Path(__file__).resolve().parents[3]
IN_CONSTRAINTS = ("grpc-aio", "fastapi", "mosec")
"""Peers whose requirements can be met with all pins of constraints.txt."""


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the shipped CAB alone, which loads faster."""
    folder = tmp_path_factory.mktemp("models")
    (folder / "cab").symlink_to(ROOT / "model/checkpoints/cab")
    return folder


def network(models: Path) -> Network:
    return Network(ServedModel(0, models, "cab", "eager", None))


@pytest.mark.parametrize("name", PEERS)
async def test_a_peer_is_compared_with_our_server(name: str, models: Path, tmp_path: Path) -> None:
    if interpreter(name) is None:
        pytest.skip(f"{PEERS[name].package} is not installed: make peers-install")
    options = Options(models, agents=(1, 2), clients=(1, 2), seconds=0.1, warm_up=0.0)
    take = await compare(name, options)
    assert [(one.agents, one.clients) for one in take.measurements] == [(1, 1), (1, 2), (2, 1), (2, 2)]
    for one in take.measurements:
        for side in (one.ours, one.peer):
            assert side.answers_checked >= 2
            assert side.calls_per_second > 0
            assert side.p50_ms <= side.p99_ms

    comparisons = Comparisons()
    comparisons.add(take)
    comparisons.add(take)
    comparisons.write(tmp_path)
    assert Comparisons.read(tmp_path / "peers.json") == comparisons
    tables = (tmp_path / "peers.md").read_text(encoding="utf-8")
    assert (
        len(re.findall(rf"^\| {re.escape(take.title)} \|", tables, re.MULTILINE)) == 2
    )  # a row for each size


def test_joined_calls_get_the_answers_of_single_calls(models: Path) -> None:
    prepared = PreparedRequests(models, "cab", made_up_requests("cab", agents=60, scenes=3))
    calls = [unpack(request.body) for request in prepared.encoded(Packed())]
    served = network(models)
    batch = served.batch(calls)  # two forwards: 120 and 60 agents
    for call, own in zip(calls, batch, strict=True):
        for name, values in served(call).items():
            np.testing.assert_allclose(own[name], values, atol=1e-4)


def test_a_wrong_answer_is_noticed(models: Path) -> None:
    prepared = PreparedRequests(models, "cab", made_up_requests("cab", agents=2, scenes=1))
    codec = Packed()
    [request] = prepared.encoded(codec)
    answer = network(models)(unpack(request.body))
    assert prepared.fault(0, codec.encode(answer), codec) == ""
    wrong = answer | {"means": answer["means"] + np.float32(0.01)}
    assert "off by 0.01 m" in prepared.fault(0, codec.encode(wrong), codec)
    cut = answer | {"means": answer["means"][:1]}
    assert "of another shape" in prepared.fault(0, codec.encode(cut), codec)
    assert "safetensors" in prepared.fault(0, b"nothing", codec)


async def test_a_peer_that_does_not_start_says_why(models: Path) -> None:
    served = ServedModel(free_port(), models, "covernet", "onnxruntime", None)
    with pytest.raises(RuntimeError, match="there is no model 'covernet'"):
        async with running("grpc-aio", served, b""):
            pass


def test_an_unknown_peer_is_refused() -> None:
    result = CliRunner().invoke(app, ["nginx"])
    assert result.exit_code == 2
    assert "there is no peer nginx" in result.output


@pytest.mark.parametrize(
    "file", sorted((ROOT / "loadtest/peers").glob("requirements-*.txt")), ids=lambda f: f.stem
)
def test_requirements_are_pinned_and_run_the_network_that_we_run(file: Path) -> None:
    name = file.stem.removeprefix("requirements-")
    assert name in PEERS
    pins = _pins(file)
    ours = _pins(ROOT / "constraints.txt")
    shared = pins.keys() & ours.keys() if name in IN_CONSTRAINTS else {"torch", "onnxruntime", "safetensors"}
    assert {"torch", "onnxruntime", "safetensors"} <= shared
    assert {one: pins[one] for one in shared} == {one: ours[one] for one in shared}


def _pins(file: Path) -> dict[str, str]:
    lines = [
        line for line in file.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")
    ]
    pairs = [line.partition("==") for line in lines]
    assert all(version for _, _, version in pairs)
    return {re.sub(r"[-_.]+", "-", name).lower(): version for name, _, version in pairs}
