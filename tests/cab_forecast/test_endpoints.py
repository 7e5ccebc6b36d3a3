"""Parsing of endpoints."""

import pytest

from cab_forecast.endpoints import DEFAULT_ENDPOINT, Endpoint, parse_endpoint


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("grpc://car:1234", Endpoint("grpc://car:1234", "grpc", False, "car:1234")),
        ("car:1234", Endpoint("grpc://car:1234", "grpc", False, "car:1234")),
        ("car", Endpoint("grpc://car:50051", "grpc", False, "car:50051")),
        ("grpcs://car", Endpoint("grpcs://car:50051", "grpc", True, "car:50051")),
        ("grpc://[::1]:9", Endpoint("grpc://[::1]:9", "grpc", False, "[::1]:9")),
        ("http://car:8080/", Endpoint("http://car:8080", "rest", False, "http://car:8080")),
        ("https://car/a/b/", Endpoint("https://car/a/b", "rest", True, "https://car/a/b")),
        ("https://[::1]", Endpoint("https://[::1]", "rest", True, "https://[::1]")),
    ],
)
def test_reads(text: str, expected: Endpoint) -> None:
    assert parse_endpoint(text) == expected


def test_default_is_what_the_server_listens_on() -> None:
    assert parse_endpoint(DEFAULT_ENDPOINT).target == "127.0.0.1:50051"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("ftp://car", "unknown scheme"),
        ("", "no host"),
        ("grpc://", "no host"),
        ("grpc://:50051", "no host"),
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
