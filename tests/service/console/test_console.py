"""The console shows a live scene of a real server, in a real browser."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from service.server import Server
from tests.service.console.browser import Console, console
from tests.service.console.traffic import SCENE, traffic
from tests.service.servers import in_thread, settings

AGENTS = 10
MODEL = "constant-velocity-yaw"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, browser: Browser) -> Iterator[Server]:
    """A server with the baselines; it starts only where there is a browser."""
    chosen = settings(models=tmp_path_factory.mktemp("models"), default_model=MODEL)
    with in_thread(chosen) as running:
        yield running


@pytest.fixture
def tab(browser: Browser, server: Server) -> Iterator[Console]:
    """The console of the server, which must not report an error."""
    with console(browser, f"http://{server.http_address}") as made:
        yield made
        assert made.faults == []


def test_a_scene_is_listed_drawn_and_explored(tab: Console, server: Server) -> None:
    page = tab.page
    tab.open()
    expect(page.get_by_role("heading", name="No scene is live")).to_be_visible()
    with traffic(f"http://{server.http_address}", AGENTS):
        page.get_by_role("link", name=SCENE).click()
        tab.wait_for_ticks()
        expect(page.locator("#agent-count")).to_have_text(f"{AGENTS}")
        assert painted(tab, "#pane-a .map-layer") > 1  # ground and road
        assert painted(tab, "#pane-a .agent-layer") > 1

        page.keyboard.press("n")
        expect(page.locator("#agent h2")).to_have_text("pedestrian-03")
        expect(page.locator("#agent .status")).to_have_text("OK")
        expect(page.locator("#agent .modes tbody tr")).to_have_count(1)
        page.get_by_role("option", name="vehicle-08").click()
        expect(page.locator("#agent .status")).to_have_text("context only")

        page.keyboard.press("Space")
        expect(page.locator("#play")).to_have_text("Live")
        paused = tab.text("#clock").split(" ")[0]
        page.keyboard.press(",")
        expect(page.locator("#clock")).not_to_contain_text(paused)
        page.keyboard.press("Space")
        tab.wait_for_ticks()
        expect(page.locator("#clock")).to_contain_text("live")


def test_the_health_page_reads_the_metrics(tab: Console, server: Server) -> None:
    with traffic(f"http://{server.http_address}", AGENTS):
        tab.open("#/health")
        figure = tab.page.locator(".figure", has_text="Predict calls/s").locator("b")
        expect(figure).not_to_have_text("0.0")
        assert 3 < float(figure.inner_text()) < 13
    expect(tab.page.locator("#health-models tbody th").filter(has_text=f"{MODEL} (default)")).to_have_count(1)
    expect(tab.page.locator("#health-version")).to_contain_text("cab.forecast.v1")


def test_every_module_is_loaded() -> None:
    folder = Path(__file__).parents[3] / "service" / "console"
    code = {file.name: file.read_text(encoding="utf-8") for file in folder.glob("*.js")}
    used = "".join(code.values()) + (folder / "index.html").read_text(encoding="utf-8")
    assert [name for name in code if name not in used] == []


def painted(tab: Console, canvas: str) -> int:
    """Return the number of colours of a canvas, every 97th pixel of it."""
    script = """selector => {
        const canvas = document.querySelector(selector);
        const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
        const colours = new Set();
        for (let at = 0; at < data.length; at += 4 * 97) colours.add(data.slice(at, at + 4).join());
        return colours.size;
    }"""
    return int(tab.page.evaluate(script, canvas))
