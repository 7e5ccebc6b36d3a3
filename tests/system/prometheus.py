"""Prometheus with the files in deploy/prometheus, on addresses and with intervals of a test."""

import json
import re
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import httpx
import yaml

from tests.deploy.files import PROMETHEUS, read_yaml
from tests.system.fleet import free_port, until
from tests.system.programs import program

Change = Callable[[str], str]
"""A function from the text of a rule file to another."""


class Prometheus:
    """A running Prometheus."""

    def __init__(self, address: str, targets: Path) -> None:
        """
        Args:
            address: HOST:PORT.
            targets: the file that lists the servers to scrape.
        """
        self._address = address
        self._targets = targets

    def ready(self) -> bool:
        """Return whether it answers queries: not while it reads its storage."""
        return httpx.get(f"http://{self._address}/-/ready").is_success

    def ask(self, query: str) -> list[Any]:
        """Return the series of a query."""
        found: list[Any] = self._get("query", query=query)["result"]
        return found

    def firing(self) -> set[str]:
        """Return the names of the alerts that fire."""
        alerts = self._get("alerts")["alerts"]
        return {alert["labels"]["alertname"] for alert in alerts if alert["state"] == "firing"}

    def scrape(self, servers: Sequence[str]) -> None:
        """Scrape these servers, HOST:PORT, from now on and no others."""
        write_targets(self._targets, servers)

    def _get(self, path: str, **parameters: str) -> dict[str, Any]:
        response = httpx.get(f"http://{self._address}/api/v1/{path}", params=parameters)
        response.raise_for_status()
        data: dict[str, Any] = response.json()["data"]
        return data


@asynccontextmanager
async def prometheus(
    folder: Path, token: str, servers: Sequence[str], balancer: str | None = None, change: Change = str
) -> AsyncIterator[Prometheus]:
    """Run Prometheus; it is ready.

    Args:
        folder: for files.
        token: key for the servers' metrics.
        servers: HOST:PORT of the servers to scrape.
        balancer: HOST:PORT of HAProxy's metrics; None: there is none.
        change: makes the rules of the test from those in the repository.
    """
    (folder / "key").write_text(token, encoding="ascii")
    config = read_yaml(PROMETHEUS / "prometheus.yml")
    config["global"] = {"scrape_interval": "1s", "evaluation_interval": "1s"}
    for name in config["rule_files"]:  # beside the configuration
        rules = yaml.safe_load(change((PROMETHEUS / name).read_text(encoding="utf-8")))
        for group in rules["groups"]:
            group["interval"] = "1s"
        (folder / name).write_text(yaml.safe_dump(rules), encoding="utf-8")
    del config["alerting"]
    scraped, balanced = config["scrape_configs"]
    del scraped["dns_sd_configs"]
    scraped["authorization"] = {"credentials_file": str(folder / "key")}
    targets = folder / "targets.json"
    write_targets(targets, servers)
    scraped["file_sd_configs"] = [{"files": [str(targets)], "refresh_interval": "1s"}]
    if balancer is None:
        del config["scrape_configs"][1]
    else:
        balanced["static_configs"] = [{"targets": [balancer]}]
    (folder / "prometheus.yml").write_text(yaml.safe_dump(config), encoding="utf-8")
    address = f"127.0.0.1:{free_port()}"
    arguments = ["--config.file", str(folder / "prometheus.yml"), "--web.listen-address", address]
    with program("prometheus", *arguments, "--storage.tsdb.path", str(folder / "data")):
        made = Prometheus(address, targets)
        await until(made.ready, "Prometheus is ready")
        yield made


def write_targets(file: Path, servers: Sequence[str]) -> None:
    """Write a file of targets, as a whole."""
    new = file.with_suffix(".new")
    new.write_text(json.dumps([{"targets": list(servers)}]), encoding="utf-8")
    new.rename(file)


def faster(windows: dict[str, str], pending: str = "1s") -> Change:
    """Return a change that shortens the rules.

    Args:
        windows: ranges of the rules and what takes their place.
        pending: what takes the place of each ``for``.

    Raises:
        ValueError: a rule has a range for which none is given.
    """

    def change(text: str) -> str:
        ranges = set(re.findall(r"\[\w+\](?: offset \w+)?", text))
        if ranges - windows.keys():
            raise ValueError(f"no shorter range is given for {sorted(ranges - windows.keys())}")
        text = re.sub(r"\[\w+\](?: offset \w+)?", lambda found: windows[found.group()], text)
        return re.sub(r"\bfor: \w+$", f"for: {pending}", text, flags=re.MULTILINE)

    return change
