"""TLS and mutual TLS with real servers, certificates and clients."""

import asyncio
import socket
import ssl
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest
import trustme
from structlog.testing import capture_logs

from cab_forecast import Client, Unavailable, Untrusted
from cab_forecast.errors import UNREACHABLE, UNTRUSTED
from service.access.tls import TlsError, read_certificates
from service.server import Server, StartError
from tests.service.certificates import HOST, write_authority, write_certificate
from tests.service.requests import make_request
from tests.service.servers import in_thread, running, settings, until


class Files:
    """Certificates of a server, of its clients and of their authorities, in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.authority, self.clients, self.stranger = trustme.CA(), trustme.CA(), trustme.CA()
        self.ca = write_authority(self.authority, folder, "server")
        self.client_ca = write_authority(self.clients, folder, "clients")
        self.strange_ca = write_authority(self.stranger, folder, "stranger")
        self.certificate, self.key = write_certificate(self.authority, folder, "server")
        self.client = write_certificate(self.clients, folder, "client")
        self.strange_client = write_certificate(self.stranger, folder, "strange-client")

    def server(self, *, mutual: bool) -> dict[str, Any]:
        """Return settings of the server."""
        pair: dict[str, Any] = {"tls_certificate": self.certificate, "tls_key": self.key}
        return pair | ({"tls_client_ca": self.client_ca} if mutual else {})

    def trusting(self, client: tuple[Path, Path] | None = None) -> dict[str, Any]:
        """Return arguments of a client that trusts the server's authority."""
        known: dict[str, Any] = {"ca_file": self.ca, "retries": 1}
        return known if client is None else known | {"certificate_file": client[0], "key_file": client[1]}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    return Files(tmp_path_factory.mktemp("certificates"))


@pytest.fixture(scope="module")
def mutual(files: Files, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """Run a server that requires certificates of its clients."""
    models = tmp_path_factory.mktemp("models")
    chosen = settings(
        models=models,
        max_batch_agents=2,
        api_tokens=("token",),
        probes="127.0.0.1:0",
        **files.server(mutual=True),
    )
    with in_thread(chosen) as running_server:
        yield running_server


@pytest.fixture(params=["grpcs", "https"])
def scheme(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def endpoint(server: Server, scheme: str) -> str:
    return f"{scheme}://{server.grpc_address if scheme == 'grpcs' else server.http_address}"


def test_clients_with_a_certificate_and_a_key_are_answered(
    mutual: Server, files: Files, scheme: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Client(endpoint(mutual, scheme), "token", **files.trusting(files.client)) as client:
        assert len(client.predict(make_request(2)).forecasts) == 2
        with client.watch_scene("s") as events:
            request = make_request(1)
            request.scene_id = "s"
            client.predict(request)
            assert next(events).instants
    for name, value in {
        "ENDPOINT": endpoint(mutual, scheme),
        "TOKEN": "token",
        "CA_FILE": files.ca,
        "CERTIFICATE_FILE": files.client[0],
        "KEY_FILE": files.client[1],
    }.items():
        monkeypatch.setenv(f"CAB_FORECAST_{name}", str(value))
    with Client.from_environment(timeout=10) as client:
        assert client.list_models()


@pytest.mark.parametrize("certificate", ["none", "strange"])
def test_clients_without_a_certificate_of_the_authority_are_refused(
    mutual: Server, files: Files, scheme: str, certificate: str
) -> None:
    with Client(
        endpoint(mutual, scheme),
        "token",
        **files.trusting(files.strange_client if certificate == "strange" else None),
    ) as client:
        with pytest.raises(Unavailable) as caught:
            client.predict(make_request())
        assert caught.value.reason == UNREACHABLE
        hint = "it may require a certificate of the client"
        assert (hint in str(caught.value)) == (certificate == "none")
    with Client(endpoint(mutual, scheme), "token", **files.trusting(files.client)) as client:
        assert client.list_models()


def test_a_server_of_another_authority_is_not_trusted(mutual: Server, files: Files, scheme: str) -> None:
    for ca_file in (None, files.strange_ca):
        with Client(endpoint(mutual, scheme), "token", ca_file=ca_file) as client:
            with pytest.raises(Untrusted, match="is not trusted") as caught:
                client.list_models()
            assert caught.value.reason == UNTRUSTED
            assert "token" not in str(caught.value)


def test_plain_text_is_not_answered(mutual: Server) -> None:
    for plain in (f"grpc://{mutual.grpc_address}", f"http://{mutual.http_address}"):
        with Client(plain, "token", retries=0) as client, pytest.raises(Unavailable):
            client.list_models()


def test_probes_need_no_certificate_on_their_own_port(mutual: Server) -> None:
    with httpx.Client(base_url=f"http://{mutual.probes_address}") as http:
        assert [http.get(path).status_code for path in ("/livez", "/readyz")] == [200, 200]
        for path in ("/metrics", "/docs", "/v1/models"):
            assert http.get(path, headers={"authorization": "Bearer token"}).status_code == 404


async def test_changed_certificates_are_taken_over(tmp_path: Path) -> None:
    files = Files(tmp_path)

    def reached(ca: Path, client: tuple[Path, Path]) -> list[bool]:
        results = []
        for scheme in ("grpcs", "https"):
            pair: dict[str, Any] = {"certificate_file": client[0], "key_file": client[1]}
            with Client(endpoint(server, scheme), retries=0, ca_file=ca, **pair) as connected:
                try:
                    connected.list_models()
                    results.append(True)
                except Unavailable:
                    results.append(False)
        return results

    async with running(max_batch_agents=2, **files.server(mutual=True)) as server:
        assert await asyncio.to_thread(reached, files.ca, files.client) == [True, True]
        # A certificate without its key, and an expired one
        other, _ = write_certificate(files.authority, tmp_path, "other")
        good = files.certificate.read_bytes()
        files.certificate.write_bytes(other.read_bytes())
        with capture_logs() as logs:
            await server.access.refresh()
            await server.access.refresh()
        assert [entry["event"] for entry in logs] == [
            "certificates not reloaded; the former ones stay in use"
        ]
        assert "no certificate and its key" in logs[0]["reason"]
        assert await asyncio.to_thread(reached, files.ca, files.client) == [True, True]
        files.certificate.write_bytes(good)
        # Other authorities, of the server and of its clients
        write_certificate(files.stranger, tmp_path, "server")
        write_authority(files.stranger, tmp_path, "clients")
        with capture_logs() as logs:
            await server.access.refresh()
        assert [entry["event"] for entry in logs] == ["certificates reloaded"]
        new_ca, new_client = files.strange_ca, files.strange_client
        assert await asyncio.to_thread(reached, new_ca, new_client) == [True, True]
        assert await asyncio.to_thread(reached, files.ca, files.client) == [False, False]
        assert await asyncio.to_thread(reached, new_ca, files.client) == [False, False]


async def test_an_expired_certificate_is_not_trusted(tmp_path: Path, scheme: str) -> None:
    files = Files(tmp_path)
    write_certificate(files.authority, tmp_path, "server", not_after=datetime.now(UTC) - timedelta(minutes=1))

    def call() -> None:
        with Client(endpoint(server, scheme), **files.trusting()) as client:
            client.list_models()

    async with running(max_batch_agents=2, **files.server(mutual=False)) as server:
        with pytest.raises(Untrusted, match="expired"):
            await asyncio.to_thread(call)


async def test_handshakes_are_bounded_in_time_and_number(tmp_path: Path) -> None:
    files = Files(tmp_path)
    limits = {"max_concurrent_calls": 4, "max_watchers": 1, "header_timeout": 0.5}
    async with running(max_batch_agents=2, **limits, **files.server(mutual=False)) as server:
        host, port = server.http_address.rsplit(":", 1)
        silent = [await asyncio.open_connection(host, int(port)) for _ in range(30)]
        limits_of = server._http._limits
        await until(lambda: 0 < len(limits_of.handshakes) <= limits_of.max_connections)
        context = ssl.create_default_context(cafile=files.ca)
        async with httpx.AsyncClient(verify=context, base_url=f"https://{server.http_address}") as http:
            assert (await http.get("/livez")).status_code == 200
        async with asyncio.timeout(10):
            for reader, _ in silent:
                with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
                    await reader.readexactly(1)
        assert not limits_of.handshakes
        for _, writer in silent:
            writer.close()


def test_files_that_are_no_certificates(files: Files, tmp_path: Path) -> None:
    nowhere, text = tmp_path / "nowhere.pem", tmp_path / "text.pem"
    text.write_text("hello")
    for chain, key, client_ca in (
        (nowhere, files.key, None),
        (files.certificate, nowhere, None),
        (text, files.key, None),
        (files.certificate, files.client[1], None),
        (files.certificate, files.key, text),
        (files.certificate, files.key, nowhere),
    ):
        with pytest.raises(TlsError, match=r"\.(pem|key)"):
            read_certificates(chain, key, client_ca)
    with pytest.raises(StartError, match=r"tls: .*nowhere\.pem: No such file"):
        Server(settings(tls_certificate=nowhere, tls_key=files.key))


def test_a_server_on_all_addresses_needs_keys() -> None:
    with pytest.raises(StartError, match=r"http: 0\.0\.0\.0:0 can be reached from other machines"):
        Server(settings(http="0.0.0.0:0"))


def test_a_taken_port_for_probes() -> None:
    async def start(address: str) -> None:
        await Server(settings(probes=address)).start()

    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        address = f"{HOST}:{taken.getsockname()[1]}"
        with pytest.raises(StartError, match=f"probes: cannot listen on {address}"):
            asyncio.run(start(address))
