"""The files in deploy/."""

from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]
DEPLOY = ROOT / "deploy"
PROMETHEUS = DEPLOY / "prometheus"


def read_yaml(path: Path) -> Any:
    """Return the single document of a YAML file."""
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def rules(name: str) -> list[dict[str, Any]]:
    """Return all rules of a Prometheus rule file, in order."""
    return [rule for group in read_yaml(PROMETHEUS / name)["groups"] for rule in group["rules"]]


def job_name() -> str:
    """Return the job name under which Prometheus scrapes the servers."""
    [scrape] = read_yaml(PROMETHEUS / "prometheus.yml")["scrape_configs"]
    name: str = scrape["job_name"]
    return name
