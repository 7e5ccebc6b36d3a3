"""Recordings of a running server: read by the mcap library, and replayed over both transports."""

import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1 import recording_pb2
from cab_forecast import Client, demo_request
from cab_forecast.recordings import read_recording
from cab_forecast.replay import Replayed, replay, replay_request
from service.recording import mcap_file
from service.recording.factory import make_recorder
from service.recording.folder import CALLS, FRAMES, GRID, MAPS, SCENE
from service.server import Server, StartError
from service.settings import Settings
from service.telemetry.metrics import Metrics
from tests.service.recording.disk import FullFile
from tests.service.requests import make_request
from tests.service.servers import TRANSPORTS, in_thread, running, settings, until

ROOT = Path(__file__).resolve().parents[3]
TICKS = 5
MADE = 2 * (TICKS + 1)
"""Number of calls of both transports, before they are replayed."""


@dataclass
class Recording:
    """A recording of the demo, and its replays."""

    file: Path
    calls: list[recording_pb2.RecordedCall]
    replays: dict[str, list[Replayed]]
    """Replays to the same models, by transport."""
    other: list[Replayed]
    """Replay to another model."""


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Record a server with CAB and the baselines, and replay the calls to it over both transports."""
    models, folder = tmp_path_factory.mktemp("models"), tmp_path_factory.mktemp("recording")
    (models / "cab").symlink_to(ROOT / "model/checkpoints/cab")
    values = settings(models=models, max_batch_agents=11, record=folder, store_budget_ms=2000)
    replays = {}
    with in_thread(values) as server:
        endpoints = {"grpc": f"grpc://{server.grpc_address}", "rest": f"http://{server.http_address}"}
        for endpoint in endpoints.values():
            with Client(endpoint) as client:
                client.reset_scene("demo")
                for request in requests():
                    client.predict(request, timeout=20)
        wait_for_calls(server, MADE)
        [file] = folder.glob("*.mcap")
        calls = list(read_recording(file))
        for transport, endpoint in endpoints.items():
            with Client(endpoint, timeout=20) as client:
                replays[transport] = list(replay(client, calls))
        with Client(endpoints["grpc"], timeout=20) as client:
            other = list(replay(client, calls, "kalman"))
    return Recording(file, calls, replays, other)


def counted(server: Server, result: str) -> float | None:
    """Return the number of calls that the recorder counted so."""
    labels = {"result": result}
    return server.metrics.registry.get_sample_value("forecast_recorded_calls_total", labels)


def wait_for_calls(server: Server, calls: int) -> None:
    """Wait until that many calls are on disk."""
    end = time.monotonic() + 20
    while counted(server, "written") != calls:
        assert time.monotonic() < end
        time.sleep(0.01)


def requests() -> Iterator[pb.PredictRequest]:
    """Yield ticks of the demo that rely on the track memory, and a call with samples whose seed is drawn."""
    demo = demo_request()
    for back in range(TICKS - 1, -1, -1):
        tick = pb.PredictRequest()
        tick.CopyFrom(demo)
        tick.options.history = pb.HISTORY_SOURCE_MEMORY
        tick.options.consistency = True
        del tick.agents[:]
        for agent in demo.agents:
            if len(agent.states) > back:
                newest = agent.states[-1 - back]
                tick.time = newest.time
                tick.agents.add(id=agent.id, type=agent.type, states=[newest])
        yield tick
    demo.options.samples = 3
    demo.scene_id = ""
    yield demo


def test_the_mcap_library_reads_it(recording: Recording) -> None:
    counts: Counter[str] = Counter()
    decoded: dict[str, list[Any]] = {}
    with recording.file.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for _, channel, _, message in reader.iter_decoded_messages():
            counts[channel.topic] += 1
            decoded.setdefault(channel.topic, []).append(message)
        summary = reader.get_summary()
    made = 4 * MADE  # replays are calls as well
    assert counts == {CALLS: made, SCENE: made, FRAMES: made, MAPS: 1, GRID: 1}
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == sum(counts.values())
    ids = {f"demo/{agent.id}" for agent in demo_request().agents}
    assert {entity.id for update in decoded[SCENE][:TICKS] for entity in update.entities} == ids
    raster = demo_request().scene_raster
    [grid] = decoded[GRID]
    assert (grid.column_count, grid.frame_id) == (raster.rows, "map")
    assert {frame.child_frame_id for frame in decoded[FRAMES]} == {"agents", "agents/demo"}


def test_the_schemas_are_the_published_ones(recording: Recording) -> None:
    """A viewer knows a message by its name, and reads it by the schema in the file: both must fit."""
    names = []
    with recording.file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    for schema in summary.schemas.values():
        assert schema.encoding == "protobuf"
        pool = DescriptorPool()
        for file in FileDescriptorSet.FromString(schema.data).file:
            pool.Add(file)
        found = pool.FindMessageTypeByName(schema.name)
        package, _, name = schema.name.rpartition(".")
        if package == "foxglove":
            published = import_module(f"foxglove_schemas_protobuf.{name}_pb2")
        else:
            published = recording_pb2
        expected = getattr(published, name).DESCRIPTOR
        assert found.file.serialized_pb == expected.file.serialized_pb
        names.append(schema.name)
    assert sorted(names) == [
        "cab.forecast.v1.RecordedCall",
        "cab.forecast.v1.RecordedMap",
        "foxglove.FrameTransform",
        "foxglove.Grid",
        "foxglove.SceneUpdate",
    ]


def test_calls_are_recorded_as_they_were_read_and_answered(recording: Recording) -> None:
    assert [call.request for call in recording.calls] == [*requests(), *requests()]
    for call in recording.calls:
        assert [one.agent_id for one in call.response.forecasts] == [one.id for one in call.request.agents]
        assert call.response.model.name == "cab"
        assert call.response.model.version
        assert call.server_version
        assert bool(call.response.seed) == bool(call.request.options.samples)


def test_histories_from_the_memory_are_recorded(recording: Recording) -> None:
    for number, call in enumerate(recording.calls[:TICKS]):
        assert {history.agent_id for history in call.recalled} == {agent.id for agent in call.request.agents}
        assert max(len(history.states) for history in call.recalled) == number + 1
        replayed = replay_request(call)
        assert not replayed.scene_id
        assert max(len(agent.states) for agent in replayed.agents) == number + 1
    assert not recording.calls[TICKS].recalled


@pytest.mark.parametrize("transport", ["grpc", "rest"])
def test_the_same_model_gives_the_same(recording: Recording, transport: str) -> None:
    replays = recording.replays[transport]
    assert len(replays) == len(recording.calls)
    for one in replays:
        assert one.difference.within(1e-4), one.difference
    assert sum(one.difference.agents for one in replays) > 2 * 10 * TICKS


def test_another_model_differs(recording: Recording) -> None:
    assert all(not one.difference.within(1e-4) for one in recording.other)
    assert max(one.difference.position_m for one in recording.other) > 1.0


def test_nothing_is_recorded_by_default() -> None:
    assert make_recorder(Settings(), Metrics()) is None


async def test_a_full_disk_costs_no_forecast(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_file, "FileIO", FullFile)
    async with running(record=tmp_path, max_batch_agents=2) as server:
        for call in TRANSPORTS.values():
            response = await call(server, make_request(2))
            assert [one.status for one in response.forecasts] == [pb.FORECAST_STATUS_OK] * 2
        await until(lambda: counted(server, "disk_full") == 2)
    assert counted(server, "written") == 0


async def test_a_missing_package_is_named_with_its_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.startswith("service.recording.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mcap_protobuf.schema", None)
    with pytest.raises(
        StartError,
        match=r'record: needs the package mcap_protobuf.schema: pip install "cab-forecast\[record\]"',
    ):
        async with running(record=tmp_path):
            pass


async def test_a_folder_that_cannot_be_written_to_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StartError, match=r"record: cannot write to .*file/recording: Not a directory"):
        async with running(record=tmp_path / "file" / "recording"):
            pass
