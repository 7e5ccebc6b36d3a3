"""The example in C++ is built and runs as its README says, over TLS, too."""

import shutil
import subprocess
from pathlib import Path

import pytest
import trustme
from pydantic import SecretStr

from service.server import Server
from service.settings import Settings
from tests.docs.pages import ROOT
from tests.examples.conftest import Run, line, run
from tests.service.certificates import write_authority, write_certificate
from tests.service.servers import in_thread

_NEEDED = ("cmake", "c++", "protoc", "grpc_cpp_plugin", "pkg-config")
_MISSING = [name for name in _NEEDED if shutil.which(name) is None]
pytestmark = [
    pytest.mark.system,  # a build takes a minute
    pytest.mark.skipif(bool(_MISSING), reason=f"not here, see examples/README.md: {', '.join(_MISSING)}"),
]


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory, server: Server) -> Path:
    """Build the example by the README's line; return the folder in which it did."""
    folder = tmp_path_factory.mktemp("cpp")
    shutil.copytree(ROOT / "examples", folder / "examples")
    (folder / "proto").symlink_to(ROOT / "proto")
    build = line("cpp").rpartition("&&")[0].replace("--build build/cpp", "--build build/cpp --parallel 2")
    build = build.replace("-S", "-DCMAKE_CXX_FLAGS_RELEASE=-O0 -S")  # it is built sooner
    done = subprocess.run(  # noqa: S603
        ["bash", "-c", build],  # noqa: S607
        cwd=folder,
        capture_output=True,
        check=False,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def forecast(program: Path, server: Server, options: str = "") -> Run:
    """Run the README's program against a server."""
    return run(f"{line('cpp').rpartition('&&')[2].strip()} --deadline 20 {options}", server, program)


def test_forecasts_are_printed(program: Path, server: Server) -> None:
    done = forecast(program, server)
    assert done.returncode == 0, done.stderr
    assert "model cab@" in done.stdout
    assert "car FORECAST_STATUS_OK" in done.stdout
    assert "walker FORECAST_STATUS_FALLBACK (forecast by constant-velocity-yaw" in done.stdout
    assert done.stdout.count("in 6.00 s: x ") == 2


def test_errors_are_printed_with_their_details(program: Path, server: Server) -> None:
    done = forecast(program, server, "--horizon 0.7")
    assert done.returncode == 1
    assert "reason BAD_FIELD\n" in done.stderr
    assert "field options.horizon: must be a multiple of 0.5 s\n" in done.stderr
    late = forecast(program, server, "--deadline 0.000001")
    assert late.returncode == 1
    assert late.stderr.startswith("code 4: ")


def test_wrong_arguments_are_refused(program: Path, server: Server) -> None:
    for options, text in (
        ("--speed 3", "unknown option --speed"),
        ("--ca nothing.pem", "cannot read nothing.pem"),
    ):
        done = forecast(program, server, options)
        assert (done.returncode, done.stderr) == (2, f"{text}\n")


def test_over_tls_with_a_key(program: Path, tmp_path: Path) -> None:
    authority = trustme.CA()
    ca_file = write_authority(authority, tmp_path, "ca")
    certificate, key = write_certificate(authority, tmp_path, "server")
    (tmp_path / "models").mkdir()
    settings = Settings(
        http="127.0.0.1:0",
        grpc="127.0.0.1:0",
        models=tmp_path / "models",
        default_model="constant-velocity-yaw",
        max_batch_agents=8,
        tls_certificate=certificate,
        tls_key=key,
        api_tokens=(SecretStr("a-key"),),
    )
    with in_thread(settings) as secured:
        done = forecast(program, secured, f"--ca {ca_file} --key a-key")
        assert done.returncode == 0, done.stderr
        assert "car FORECAST_STATUS_OK" in done.stdout
        assert forecast(program, secured, f"--ca {ca_file}").stderr.startswith("code 16: ")
