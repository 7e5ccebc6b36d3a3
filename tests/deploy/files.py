"""The files in deploy/."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from service.settings import Settings, load

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"
PROMETHEUS = DEPLOY / "prometheus"


def read_yaml(path: Path) -> Any:
    """Return the single document of a YAML file."""
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def rules(name: str) -> list[dict[str, Any]]:
    """Return all rules of a Prometheus rule file, in order."""
    return [rule for group in read_yaml(PROMETHEUS / name)["groups"] for rule in group["rules"]]


def scrapes() -> list[dict[str, Any]]:
    """Return what Prometheus scrapes, the servers first."""
    found: list[dict[str, Any]] = read_yaml(PROMETHEUS / "prometheus.yml")["scrape_configs"]
    return found


def job_name() -> str:
    """Return the job name under which Prometheus scrapes the servers."""
    name: str = scrapes()[0]["job_name"]
    return name


def image_environment() -> dict[str, str]:
    """Return the settings in the Dockerfile."""
    return dict(re.findall(r"\b(FORECAST_\w+)=(\S+)", (ROOT / "Dockerfile").read_text()))


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
