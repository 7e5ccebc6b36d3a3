"""docker-compose.yml and the files that it mounts fit each other and the server's settings."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from loadtest.redis_servers import single
from service.access.gate import require_protection
from service.access.key_file import read_keys
from service.access.scopes import Scope
from service.environment import CONFIG, PREFIX
from service.settings import Settings, SettingsError, split_address
from service.transports.streams import HEARTBEAT
from tests.deploy.files import (
    DEPLOY,
    ROOT,
    image_environment,
    image_ports,
    read_yaml,
    scrapes,
    settings_of,
)
from tests.service.tracking.store.stores import opened, require_redis, scene_name
from tests.service.tracking.store.track_updates import START, track_update

SERVICES: dict[str, Any] = read_yaml(ROOT / "docker-compose.yml")["services"]
SECRETS = read_yaml(ROOT / "docker-compose.yml")["secrets"]


def test_the_image_listens_where_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = settings_of(monkeypatch, {})
    assert {split_address(address)[1] for address in (settings.http, settings.grpc)} == image_ports()


def secrets(folder: Path, *arguments: str) -> Path:
    """Run deploy/secrets.sh in a copy; return the folder of the secrets."""
    (folder / "deploy").mkdir(exist_ok=True)
    shutil.copy(DEPLOY / "secrets.sh", folder / "deploy")
    subprocess.run(  # noqa: S603
        ["/bin/sh", "deploy/secrets.sh", *arguments],
        cwd=folder,
        env=os.environ | {"CAB_FORECAST": f"{sys.executable} -m service"},
        check=True,
        capture_output=True,
    )
    return folder / "secrets"


def test_the_servers_are_configured_by_the_secrets(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    made = secrets(tmp_path)
    forecast = SERVICES["forecast"]
    [volume] = forecast["volumes"]
    given = {name: value for name, value in forecast["environment"].items() if value is not None}
    passed_on = forecast["environment"].keys() - given.keys()
    assert {name.removeprefix(PREFIX).lower() for name in passed_on} <= Settings.model_fields.keys()
    assert given == {CONFIG: "/etc/cab-forecast/forecast.toml"}
    assert volume == "./secrets/forecast:/etc/cab-forecast:ro"
    settings = settings_of(monkeypatch, {CONFIG: str(made / "forecast/forecast.toml")})
    [password] = re.findall(r"^requirepass (\S+)$", (made / "redis.conf").read_text())
    assert settings.store == f"redis://:{password}@redis:6379"
    assert str(settings.keys_file) == "/etc/cab-forecast/keys.json"
    scopes = {key.name: set(key.scopes) for key in read_keys(made / "forecast/keys.json")}
    assert scopes["prometheus"] == {Scope.METRICS}
    assert Scope.PREDICT in scopes["me"]
    assert {Path(each["file"]) for each in SECRETS.values()} <= {
        Path("secrets") / file.name for file in made.iterdir()
    }
    before = (made / "redis.conf").read_text()
    secrets(tmp_path)
    assert (made / "redis.conf").read_text() == before, "a second run changes nothing"


def test_without_keys_the_secrets_hold_the_word(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made = secrets(tmp_path, "--allow-anyone")
    settings = settings_of(monkeypatch, {CONFIG: str(made / "forecast/forecast.toml")})
    require_protection(settings)
    assert settings.keys_file is None


def test_the_servers_wait_for_redis_and_get_time_to_drain(monkeypatch: pytest.MonkeyPatch) -> None:
    forecast = SERVICES["forecast"]
    [(dependency, how)] = forecast["depends_on"].items()
    assert dependency in SERVICES
    assert how == {"condition": "service_healthy", "required": False}
    settings = settings_of(monkeypatch, {})
    assert int(forecast["stop_grace_period"].removesuffix("s")) > settings.drain_seconds
    assert forecast["deploy"]["replicas"] >= 2


def test_the_image_demands_keys_or_the_word(monkeypatch: pytest.MonkeyPatch) -> None:
    image = settings_of(monkeypatch, {})
    with pytest.raises(SettingsError, match=r"FORECAST_KEYS_FILE, or set FORECAST_ALLOW_ANYONE=true"):
        require_protection(image)
    require_protection(settings_of(monkeypatch, {f"{PREFIX}ALLOW_ANYONE": "true"}))
    assert image.probes is not None
    assert f"HTTPConnection('{image.probes}', timeout=4)" in (ROOT / "Dockerfile").read_text()


def test_haproxy_fits_the_servers(monkeypatch: pytest.MonkeyPatch) -> None:
    """tests/system runs it."""
    haproxy = SERVICES["haproxy"]
    assert {int(port.rpartition(":")[2]) for port in haproxy["ports"]} == image_ports()
    text = (DEPLOY / "haproxy/haproxy.cfg").read_text()
    assert set(re.findall(r"forecast:(\d+)", text)) == {str(port) for port in image_ports()}
    settings = settings_of(monkeypatch, {})
    waits = {name: float(value) for name, value in re.findall(r"timeout ([\w-]+) (\d+)s", text)}
    assert waits["http-keep-alive"] < settings.idle_timeout
    assert min(waits["client"], waits["server"]) > max(settings.max_timeout, 2 * HEARTBEAT - 1)
    [connections] = re.findall(r"maxconn (\d+)", text)
    assert int(connections) > 2 * (settings.max_concurrent_calls + settings.max_watchers)


def test_every_mounted_file_is_there() -> None:
    mounted = [volume for service in SERVICES.values() for volume in service.get("volumes", ())]
    files = {volume.partition(":")[0] for volume in mounted if volume.startswith("./deploy")}
    assert len(files) >= 5
    for file in files:
        assert (ROOT / file).exists(), file
    used = {name for service in SERVICES.values() for name in service.get("secrets", ())}
    assert used == SECRETS.keys()


def test_every_service_is_pinned_and_without_rights() -> None:
    for name, service in SERVICES.items():
        assert re.fullmatch(r"\S+:v?\d+\.\d+\S*", service["image"]), name
        assert service["read_only"], name
        assert service["deploy"]["resources"]["limits"].keys() == {"cpus", "memory"}, name
        assert service["cap_drop"] == ["ALL"], name
        assert all(port.startswith("127.0.0.1:") for port in service.get("ports", ())), name


def test_prometheus_finds_its_files_and_every_replica() -> None:
    prometheus = SERVICES["prometheus"]
    assert prometheus["profiles"] == ["monitoring"]
    folder, _, inside = prometheus["volumes"][0].partition(":")
    assert (ROOT / folder / "prometheus.yml").is_file()
    assert inside == "/etc/prometheus:ro"
    servers, balancer = scrapes()
    [found] = servers["dns_sd_configs"]
    assert found["names"] == ["forecast"]
    assert found["names"][0] in SERVICES
    assert found["port"] == split_address(image_environment()[PREFIX + "HTTP"])[1]
    [key] = prometheus["secrets"]
    assert servers["authorization"] == {"credentials_file": f"/run/secrets/{key}"}
    assert balancer["static_configs"] == [{"targets": ["haproxy:8404"]}]
    alerting = read_yaml(ROOT / folder / "prometheus.yml")["alerting"]
    assert alerting["alertmanagers"] == [{"static_configs": [{"targets": ["alertmanager:9093"]}]}]
    assert "alertmanager" in SERVICES


def test_grafana_has_the_dashboard_and_its_data() -> None:
    provisioning = DEPLOY / "grafana/provisioning"
    [source] = read_yaml(provisioning / "datasources/prometheus.yml")["datasources"]
    host, port = split_address(source["url"].removeprefix("http://"))
    assert f"127.0.0.1:{port}:{port}" in SERVICES[host]["ports"]
    [provider] = read_yaml(provisioning / "dashboards/cab-forecast.yml")["providers"]
    mounts = [volume.split(":")[:2] for volume in SERVICES["grafana"]["volumes"]]
    assert [
        "./deploy/grafana/cab-forecast.json",
        f"{provider['options']['path']}/cab-forecast.json",
    ] in mounts


async def test_redis_understands_its_options_and_all_that_is_in_it_expires() -> None:
    """The eviction policy volatile-ttl needs an expiry on every key."""
    program, password, *options = SERVICES["redis"]["command"]
    assert program == "redis-server"
    assert password == f"/run/secrets/{SERVICES['redis']['secrets'][0]}"
    scene = scene_name()
    require_redis()
    with single(*options) as redis:
        assert redis.command("CONFIG", "GET", "maxmemory-policy") == [b"maxmemory-policy", b"volatile-ttl"]
        assert redis.command("CONFIG", "GET", "maxmemory") == [b"maxmemory", b"%d" % (640 * 2**20)]
        assert redis.command("CONFIG", "GET", "save") == [b"save", b""]
        async with opened(redis.url) as store:
            watching = store.watch(scene)
            await anext(watching)
            await store.exchange(scene, START, [track_update(START)])
            await store.publish(scene, [b"event"])
            await watching.aclose()
        keys = redis.command("KEYS", "*")
        assert isinstance(keys, list)
        assert len(keys) == 4
        for key in keys:
            left = redis.command("PTTL", key.decode())
            assert isinstance(left, int)
            assert 0 < left <= 30_000, key
