"""``cab-forecast consistency`` against the real server with a fake consistency service."""

import json
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest
import structlog
from google.protobuf import json_format
from google.protobuf.message import Message
from pydantic import SecretStr
from typer.testing import CliRunner

from cab.forecast.v1 import consistency_service_pb2 as pb
from cli.main import app
from service import errors
from service.server import Server
from tests.cab_forecast.fakes import free_port
from tests.service.planes import AGENT, EVENT, MODELS, RESET, SCENE, FakePlane, with_fake_plane
from tests.service.servers import in_thread, settings

run = CliRunner().invoke
COMMANDS: list[tuple[list[str], Message, Message]] = [
    (["models"], pb.ListModelConsistencyRequest(), MODELS),
    (["scene", "s"], pb.GetSceneConsistencyRequest(scene_id="s"), SCENE),
    (["agent", "s", "a"], pb.GetAgentConsistencyRequest(scene_id="s", agent_id="a"), AGENT),
    (
        ["agent", "s", "a", "--window=3.5"],
        pb.GetAgentConsistencyRequest(scene_id="s", agent_id="a", window=3.5),
        AGENT,
    ),
    (["reset", "s"], pb.ResetSceneRequest(scene_id="s"), RESET),
]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """Serve the baselines without logging, because server and command share their output."""
    models = tmp_path_factory.mktemp("models")
    chosen = settings(models=models, api_tokens=(SecretStr("token"),))
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    with in_thread(chosen) as running:
        yield running
    structlog.reset_defaults()


@pytest.fixture(autouse=True)
def plane(server: Server, monkeypatch: pytest.MonkeyPatch) -> FakePlane:
    """Replace the server's consistency service, and set the server as the command's default endpoint."""
    monkeypatch.setenv("CAB_FORECAST_ENDPOINT", f"grpc://{server.grpc_address}")
    monkeypatch.setenv("CAB_FORECAST_TOKEN", "token")
    return with_fake_plane(server)


@pytest.mark.parametrize(("arguments", "asked", "answer"), COMMANDS, ids=lambda row: str(row)[:20])
def test_asks_and_prints_json(
    server: Server, plane: FakePlane, arguments: list[str], asked: Message, answer: Message
) -> None:
    rest = ["--endpoint", f"http://{server.http_address}", "--token", "token"]
    for options in ([], rest):
        result = run(app, ["consistency", *arguments, "--json", *options])
        assert result.exit_code == 0, result.stderr
        assert json_format.ParseDict(json.loads(result.stdout), type(answer)()) == answer
    assert plane.asked == [asked, asked]


def test_tables() -> None:
    models = run(app, ["consistency", "models"]).stdout
    assert "fake@1.0.0" in models
    assert "0.25" in models
    scene = run(app, ["consistency", "scene", "s"]).stdout
    assert "Newest observation of each agent" in scene
    assert "sets" in scene
    agent = run(app, ["consistency", "agent", "s", "a"]).stdout
    for part in ("1700000000.25", "settled", "0.31", "2.5", "1.20"):
        assert part in agent
    assert run(app, ["consistency", "reset", "s"]).stdout == "forgot 7 agents\n"


def test_watch(plane: FakePlane, server: Server) -> None:
    """The command runs in its own process, which Ctrl-C ends."""
    # A shell that runs the tests in the background ignores SIGINT, which this process would inherit
    heed = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    program = f"{heed}; from cli.main import app; app()"
    command = [sys.executable, "-c", program, "consistency", "watch", "s"]
    for options, expected in (([], "C(1 m) 2.5"), (["--json"], '"missed"')):
        with subprocess.Popen(  # noqa: S603
            [*command, *options],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
        ) as process:
            try:
                plane.wait(1)
                plane.send(EVENT)
                assert process.stdout is not None
                lines = [process.stdout.readline()]
                if not options:
                    assert lines == ["2 events were missed\n"]
                    lines.append(process.stdout.readline())
                assert expected in lines[-1]
                process.send_signal(signal.SIGINT)
                assert process.wait(10) == 0
            finally:
                process.kill()  # otherwise a failure would hang
        plane.wait(0)


def test_the_server_ends_a_watch(plane: FakePlane) -> None:
    def end() -> None:
        plane.wait(1)
        plane.send(EVENT)
        plane.send(None)

    ending = threading.Thread(target=end)
    ending.start()
    result = run(app, ["consistency", "watch", "s", "--json"])
    ending.join()
    assert result.exit_code == 0
    assert json_format.Parse(result.stdout, pb.WatchSceneResponse()) == EVENT
    assert result.stderr == "the server ended the watch\n"


def test_errors_are_one_line(plane: FakePlane) -> None:
    plane.error = errors.UnknownTrack("nothing is remembered of this scene")
    for arguments in (["scene", "s"], ["agent", "s", "a"], ["watch", "s"]):
        result = run(app, ["consistency", *arguments])
        assert (result.exit_code, result.stdout) == (1, "")
        assert result.stderr == "error: nothing is remembered of this scene\n"
    refused = run(app, ["consistency", "models", "--token", "guess"])
    assert "--token" in refused.stderr
    nobody = run(app, ["consistency", "models", "--endpoint", f"http://127.0.0.1:{free_port()}"])
    assert nobody.stderr.endswith("start one with: cab-forecast serve)\n")
    assert "unknown scheme" in run(app, ["consistency", "models", "--endpoint", "ftp://x"]).stderr


def test_without_a_command_it_says_what_there_is() -> None:
    text = run(app, ["consistency"]).output
    for command in ("models", "scene", "agent", "watch", "reset"):
        assert command in text
