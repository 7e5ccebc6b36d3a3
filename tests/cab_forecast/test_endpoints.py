"""Parsing of endpoints."""

import pytest

from cab_forecast.endpoints import DEFAULT_ENDPOINT, Endpoint, parse_endpoint


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("grpc://car:1234", Endpoint("grpc://car:1234", "grpc", False, "car:1234", "car")),
        ("car:1234", Endpoint("grpc://car:1234", "grpc", False, "car:1234", "car")),
        ("car", Endpoint("grpc://car:50051", "grpc", False, "car:50051", "car")),
        ("grpcs://car", Endpoint("grpcs://car:50051", "grpc", True, "car:50051", "car")),
        ("grpc://[::1]:9", Endpoint("grpc://[::1]:9", "grpc", False, "[::1]:9", "[::1]")),
        ("dns:///car:9", Endpoint("grpc://car:9", "grpc", False, "car:9", "car")),
        (
            "dns://10.0.0.2/car",
            Endpoint("dns://10.0.0.2/car:50051", "grpc", False, "dns://10.0.0.2/car:50051", "car"),
        ),
        ("http://car:8080/", Endpoint("http://car:8080", "rest", False, "http://car:8080", "car")),
        ("https://car/a/b/", Endpoint("https://car/a/b", "rest", True, "https://car/a/b", "car")),
        ("https://[::1]", Endpoint("https://[::1]", "rest", True, "https://[::1]", "[::1]")),
    ],
)
def test_reads(text: str, expected: Endpoint) -> None:
    assert parse_endpoint(text) == expected


@pytest.mark.parametrize(
    ("text", "loopback"),
    [
        ("grpc://127.0.0.2", True),
        ("http://localhost:8080", True),
        ("https://[::1]:8443", True),
        ("grpc://10.0.0.1", False),
        ("http://localhost.example.com", False),
    ],
)
def test_tells_whether_a_server_is_on_this_machine(text: str, loopback: bool) -> None:
    assert parse_endpoint(text).is_loopback == loopback


def test_default_is_what_the_server_listens_on() -> None:
    assert parse_endpoint(DEFAULT_ENDPOINT).target == "127.0.0.1:50051"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("ftp://car", "unknown scheme"),
        ("", "no host"),
        ("grpc://", "no host"),
        ("grpc://:50051", "no host"),
        ("dns://car:50051", "no host; gRPC's spelling is dns:///host:port"),
        ("dns:///", "no host"),
        ("car:99999", "[Pp]ort"),
        ("car:x", "[Pp]ort"),
        ("grpc://car/path", "no path"),
        ("http://me:secret@car", "only scheme"),
        ("http://car/?q=1", "only scheme"),
        ("http://car/#f", "only scheme"),
        ("http://[::1", "."),
    ],
)
def test_refuses(text: str, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        parse_endpoint(text)
