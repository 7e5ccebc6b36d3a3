"""The site of the documentation builds without a warning and needs no network; its links lead somewhere."""

import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

from tests.docs.pages import ROOT

_NOWHERE = "http://127.0.0.1:9"
"""A proxy that does not answer: a build that asked for something on the network would fail."""
_LOADED_BY = {
    "script": "src",
    "img": "src",
    "iframe": "src",
    "source": "src",
    "link": "href",
    "object": "data",
}
"""Attributes, by element, that name what a browser loads."""
_CSS_URL = re.compile(r"(?:url\(|@import\s+)[\"']?([^\"')\s;]+)")


class _Page(HTMLParser):
    """What a page of the site loads, where its links lead, and which anchors it has."""

    def __init__(self, file: Path) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.classes: set[str] = set()
        text = file.read_text(encoding="utf-8")
        self.feed(text)
        for style in re.findall(r"<style.*?</style>", text, re.DOTALL):
            self.loads += _CSS_URL.findall(style)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take what an element names."""
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values[name] for name in ("id", "name") if name in values}
        self.classes |= set(values.get("class", "").split())
        if tag == "a" and "href" in values:
            self.links.append(values["href"])
        elif tag in _LOADED_BY and _LOADED_BY[tag] in values:
            self.loads.append(values[_LOADED_BY[tag]])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a site built as ``make docs-site`` does, but without network."""
    folder = tmp_path_factory.mktemp("site")
    proxies = dict.fromkeys(("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"), _NOWHERE)
    build = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    run = subprocess.run(  # noqa: S603
        build,
        cwd=ROOT,
        env=os.environ | proxies | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        check=False,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, _Page]:
    """The pages of the site by file."""
    return {file: _Page(file) for file in site.rglob("*.html")}


def test_it_loads_nothing_from_other_hosts(site: Path, pages: dict[Path, _Page]) -> None:
    loaded = {(file.name, url) for file, page in pages.items() for url in page.loads}
    loaded |= {
        (file.name, url) for file in site.rglob("*.css") for url in _CSS_URL.findall(file.read_text("utf-8"))
    }
    assert len(loaded) > len(pages)
    assert not {(name, url) for name, url in loaded if urlsplit(url).netloc}
    # The theme's script would load the library of these diagrams from another host
    assert not any("mermaid" in page.classes for page in pages.values())


def test_what_it_loads_and_links_to_is_there(site: Path, pages: dict[Path, _Page]) -> None:
    for file, page in pages.items():
        if file.name == "404.html":  # its links begin at the root of a host
            continue
        for url in (*page.loads, *page.links):
            parts = urlsplit(url)
            if parts.scheme:
                continue
            target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            assert target.exists(), f"{file.relative_to(site)}: {url}"
            if parts.fragment and target in pages and not parts.fragment.startswith("__"):
                assert unquote(parts.fragment) in pages[target].anchors, f"{file.relative_to(site)}: {url}"


def test_every_page_can_be_searched(site: Path, pages: dict[Path, _Page]) -> None:
    index = json.loads((site / "search/search_index.json").read_text(encoding="utf-8"))
    found = {entry["location"].partition("#")[0] for entry in index["docs"]}
    assert {file.relative_to(site).as_posix() for file in pages} - {"404.html"} == found
