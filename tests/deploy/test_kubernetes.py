"""The Kubernetes manifests fit each other and the server's settings."""

import re
from typing import Any

import pytest
import yaml

from service.access.gate import require_protection
from tests.deploy.files import DEPLOY, ROOT, image_ports, job_name, read_yaml, settings_of
from tests.deploy.promql import labels_of
from tests.deploy.series import Series

BASE = DEPLOY / "kubernetes/base"
BUILD = read_yaml(BASE / "kustomization.yaml")
BY_KIND: dict[str, Any] = {
    each["kind"]: each
    for file in BUILD["resources"]
    for each in yaml.safe_load_all((BASE / file).read_text(encoding="utf-8"))
}
DEPLOYMENT = BY_KIND["Deployment"]
POD = DEPLOYMENT["spec"]["template"]["spec"]
[CONTAINER] = POD["containers"]
LABELS = DEPLOYMENT["spec"]["template"]["metadata"]["labels"]
_PROBES = ("startupProbe", "readinessProbe", "livenessProbe")


def environment() -> dict[str, str]:
    """Return the container's environment, with a made-up value for that of a secret."""
    return {each["name"]: each.get("value", "redis://:x@redis:6379") for each in CONTAINER["env"]}


def test_all_files_are_built() -> None:
    assert {file.name for file in BASE.glob("*.yml")} == set(BUILD["resources"])
    assert BY_KIND.keys() == {
        "Deployment",
        "Service",
        "HorizontalPodAutoscaler",
        "PodDisruptionBudget",
        "ServiceMonitor",
        "NetworkPolicy",
    }


def test_the_server_starts_with_these_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = settings_of(monkeypatch, environment())
    require_protection(settings)
    [mount] = CONTAINER["volumeMounts"]
    assert settings.keys_file is not None
    assert str(settings.keys_file.parent) == mount["mountPath"]
    assert settings.threads == int(CONTAINER["resources"]["requests"]["cpu"])
    ports = {each["name"]: each["containerPort"] for each in CONTAINER["ports"]}
    assert set(ports.values()) == image_ports()
    [_, pause] = CONTAINER["lifecycle"]["preStop"]["exec"]["command"]
    assert POD["terminationGracePeriodSeconds"] > int(pause) + settings.drain_seconds
    [user] = re.findall(r"--uid (\d+)", (ROOT / "Dockerfile").read_text())
    assert POD["securityContext"]["runAsUser"] == int(user)


@pytest.mark.parametrize("name", _PROBES)
def test_a_busy_server_meets_the_probes(name: str) -> None:
    """The default time-out of a probe is a second, which a busy event loop can miss."""
    probe = CONTAINER[name]
    assert probe["httpGet"]["port"] == "http"
    assert probe["httpGet"]["path"] == ("/livez" if name == "livenessProbe" else "/readyz")
    assert probe["timeoutSeconds"] >= 5


def test_secrets_are_named_and_never_written_down() -> None:
    named = {each["secret"]["secretName"] for each in POD["volumes"]}
    named |= {each["valueFrom"]["secretKeyRef"]["name"] for each in CONTAINER["env"] if "valueFrom" in each}
    [endpoint] = BY_KIND["ServiceMonitor"]["spec"]["endpoints"]
    named.add(endpoint["authorization"]["credentials"]["name"])
    told = (BASE / "kustomization.yaml").read_text()
    assert named == set(re.findall(r"create secret generic (\S+)", told))


def test_all_select_the_same_pods_and_ports() -> None:
    assert DEPLOYMENT["spec"]["selector"]["matchLabels"] == LABELS
    assert BY_KIND["Service"]["spec"]["selector"] == LABELS
    assert BY_KIND["PodDisruptionBudget"]["spec"]["selector"]["matchLabels"] == LABELS
    assert BY_KIND["NetworkPolicy"]["spec"]["podSelector"]["matchLabels"] == LABELS
    assert (
        BY_KIND["ServiceMonitor"]["spec"]["selector"]["matchLabels"]
        == (BY_KIND["Service"]["metadata"]["labels"])
    )
    named = {each["name"] for each in CONTAINER["ports"]}
    assert {each["targetPort"] for each in BY_KIND["Service"]["spec"]["ports"]} == named
    let_in = {port["port"] for rule in BY_KIND["NetworkPolicy"]["spec"]["ingress"] for port in rule["ports"]}
    assert let_in == named
    scaled = BY_KIND["HorizontalPodAutoscaler"]["spec"]["scaleTargetRef"]
    assert (scaled["kind"], scaled["name"]) == ("Deployment", DEPLOYMENT["metadata"]["name"])
    compose = read_yaml(ROOT / "docker-compose.yml")["services"]["forecast"]
    assert CONTAINER["image"] == compose["image"]


def test_prometheus_scrapes_under_the_name_that_alerts_select() -> None:
    [endpoint] = BY_KIND["ServiceMonitor"]["spec"]["endpoints"]
    assert endpoint["port"] == "http"
    assert endpoint["relabelings"] == [{"targetLabel": "job", "replacement": job_name()}]


def test_the_autoscaler_gets_its_metric_from_what_the_server_exports(series: Series) -> None:
    [rule] = read_yaml(DEPLOY / "kubernetes/prometheus-adapter.yml")["rules"]
    query = rule["metricsQuery"].replace("<<.GroupBy>>", "instance").replace("<<.LabelMatchers>>", "")
    query = query.replace("<<.Series>>", rule["seriesQuery"].partition("{")[0])
    labels_of(query, series)
    metrics = BY_KIND["HorizontalPodAutoscaler"]["spec"]["metrics"]
    assert [each["pods"]["metric"]["name"] for each in metrics if each["type"] == "Pods"] == [
        rule["name"]["as"]
    ]


def test_the_overlay_for_gpus_patches_what_there_is() -> None:
    overlay = DEPLOY / "kubernetes/overlays/gpu"
    build = read_yaml(overlay / "kustomization.yaml")
    [below] = build["resources"]
    assert (overlay / below).resolve() == BASE.resolve()
    [patch] = build["patches"]
    changed = read_yaml(overlay / patch["path"])
    assert changed["metadata"]["name"] == DEPLOYMENT["metadata"]["name"]
    [container] = changed["spec"]["template"]["spec"]["containers"]
    assert container["name"] == CONTAINER["name"]
    assert container["resources"]["limits"]["nvidia.com/gpu"] == "1"
    assert "ARG TORCH_INDEX=" in (ROOT / "Dockerfile").read_text()
