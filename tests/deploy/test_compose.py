"""docker-compose.yml and the Kubernetes manifests fit the server's settings."""

import re
from typing import Any

import pytest
import yaml

from loadtest.redis_servers import single
from service.access.gate import require_protection
from service.environment import PREFIX
from service.settings import Settings, SettingsError, load, split_address
from tests.deploy.files import DEPLOY, ROOT, job_name, read_yaml
from tests.service.tracking.store.stores import opened, require_redis, scene_name
from tests.service.tracking.store.track_updates import START, track_update

SERVICES: dict[str, Any] = read_yaml(ROOT / "docker-compose.yml")["services"]
MANIFESTS = list(yaml.safe_load_all((DEPLOY / "kubernetes/forecast.yml").read_text(encoding="utf-8")))
[DEPLOYMENT] = [each for each in MANIFESTS if each["kind"] == "Deployment"]
POD = DEPLOYMENT["spec"]["template"]["spec"]
[CONTAINER] = POD["containers"]


def image_environment() -> dict[str, str]:
    """Return the settings in the Dockerfile."""
    return dict(re.findall(rf"\b({PREFIX}\w+)=(\S+)", (ROOT / "Dockerfile").read_text()))


def image_ports() -> set[int]:
    """Return the ports that the Dockerfile exposes."""
    [ports] = re.findall(r"^EXPOSE (.*)$", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    return {int(port) for port in ports.split()}


def settings_of(monkeypatch: pytest.MonkeyPatch, environment: dict[str, str]) -> Settings:
    """Return the server's settings for the image's environment and another one."""
    assert all(isinstance(value, str) for value in environment.values())
    for name, value in (image_environment() | environment).items():
        monkeypatch.setenv(name, value)
    return load()


def test_the_image_listens_where_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = settings_of(monkeypatch, {})
    assert {split_address(address)[1] for address in (settings.http, settings.grpc)} == image_ports()


def test_variables_of_the_compose_file_are_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    forecast = SERVICES["forecast"]
    assert {int(port.rpartition(":")[2]) for port in forecast["ports"]} == image_ports()
    given = {name: value for name, value in forecast["environment"].items() if value is not None}
    passed_on = forecast["environment"].keys() - given.keys()
    assert {name.removeprefix(PREFIX).lower() for name in passed_on} <= Settings.model_fields.keys()
    assert {f"{PREFIX}KEYS_FILE", f"{PREFIX}ALLOW_ANYONE"} <= passed_on
    settings = settings_of(monkeypatch, given)
    assert settings.store == "redis://redis:6379"
    [(dependency, how)] = forecast["depends_on"].items()
    assert dependency in SERVICES
    assert how == {"condition": "service_healthy", "required": False}
    assert int(forecast["stop_grace_period"].removesuffix("s")) > settings.drain_seconds


def test_the_image_demands_keys_or_the_word(monkeypatch: pytest.MonkeyPatch) -> None:
    image = settings_of(monkeypatch, {})
    with pytest.raises(SettingsError, match=r"FORECAST_KEYS_FILE, or set FORECAST_ALLOW_ANYONE=true"):
        require_protection(image)
    require_protection(settings_of(monkeypatch, {f"{PREFIX}ALLOW_ANYONE": "true"}))
    manifest = settings_of(monkeypatch, {each["name"]: each["value"] for each in CONTAINER["env"]})
    [mount] = CONTAINER["volumeMounts"]
    assert manifest.keys_file is not None
    assert str(manifest.keys_file.parent) == mount["mountPath"]
    assert image.probes is not None
    assert f"http://{image.probes}/readyz" in (ROOT / "Dockerfile").read_text()


def test_every_service_is_pinned_and_without_rights() -> None:
    for name, service in SERVICES.items():
        assert re.fullmatch(r"\S+:v?\d+\.\d+\S*", service["image"]), name
        assert service["read_only"], name
        assert service["cap_drop"] == ["ALL"], name
        assert all(port.startswith("127.0.0.1:") for port in service.get("ports", ())), name


def test_prometheus_finds_its_files_and_the_server() -> None:
    prometheus = SERVICES["prometheus"]
    assert prometheus["profiles"] == ["monitoring"]
    folder, _, inside = prometheus["volumes"][0].partition(":")
    assert (ROOT / folder / "prometheus.yml").is_file()
    assert inside == "/etc/prometheus:ro"
    [scrape] = read_yaml(ROOT / folder / "prometheus.yml")["scrape_configs"]
    assert scrape["job_name"] == job_name()
    [[target]] = [each["targets"] for each in scrape["static_configs"]]
    host, port = split_address(target)
    assert host in SERVICES
    assert port == split_address(image_environment()[PREFIX + "HTTP"])[1]


async def test_redis_understands_its_options_and_all_that_is_in_it_expires() -> None:
    """The eviction policy volatile-ttl needs an expiry on every key."""
    program, *options = SERVICES["redis"]["command"]
    assert program == "redis-server"
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


def test_the_manifest_fits_the_server(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = settings_of(monkeypatch, {each["name"]: each["value"] for each in CONTAINER["env"]})
    assert settings.threads == int(CONTAINER["resources"]["requests"]["cpu"])
    ports = {each["name"]: each["containerPort"] for each in CONTAINER["ports"]}
    assert set(ports.values()) == image_ports()
    for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
        asked = CONTAINER[probe]["httpGet"]
        assert asked["path"] in {"/readyz", "/livez"}
        assert asked["port"] == "http"
    [_, pause] = CONTAINER["lifecycle"]["preStop"]["exec"]["command"]
    assert POD["terminationGracePeriodSeconds"] > int(pause) + settings.drain_seconds
    [user] = re.findall(r"--uid (\d+)", (ROOT / "Dockerfile").read_text())
    assert POD["securityContext"]["runAsUser"] == int(user)


def test_the_manifest_holds_together() -> None:
    by_kind = {each["kind"]: each for each in MANIFESTS}
    assert by_kind.keys() == {"Deployment", "Service", "HorizontalPodAutoscaler"}
    labels = DEPLOYMENT["spec"]["template"]["metadata"]["labels"]
    assert DEPLOYMENT["spec"]["selector"]["matchLabels"] == labels
    assert by_kind["Service"]["spec"]["selector"] == labels
    named = {each["name"] for each in CONTAINER["ports"]}
    assert {each["targetPort"] for each in by_kind["Service"]["spec"]["ports"]} == named
    scaled = by_kind["HorizontalPodAutoscaler"]["spec"]["scaleTargetRef"]
    assert (scaled["kind"], scaled["name"]) == ("Deployment", DEPLOYMENT["metadata"]["name"])
    assert CONTAINER["image"] == SERVICES["forecast"]["image"]
