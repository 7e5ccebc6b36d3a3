"""The console of server processes: speed, restarts, second models, keys, keyboard, accessibility."""

import json
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, expect

from loadtest.servers import Server, serving
from service.access.key_file import Key, digest, write_keys
from service.access.scopes import Scope
from tests.service.console.browser import NAME, Console, console, launched
from tests.service.console.traffic import SCENE, traffic
from tests.system.fleet import free_port
from tests.system.programs import require

pytestmark = pytest.mark.system
AGENTS = 64
MODEL, SECOND = "constant-velocity-yaw", "kalman"
VERSION = "1.0.0"
AXE = "axe-core@4.14.1"
SECONDS = 8.0


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Return the system's Chromium; CI must have it."""
    with launched(require(NAME)) as running:
        yield running


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An empty folder: baselines only."""
    return tmp_path_factory.mktemp("models")


@pytest.fixture(scope="module")
def server(models: Path, browser: Browser) -> Iterator[Server]:
    """A server with traffic of 64 agents at 10 Hz."""
    with serving(models, default_model=MODEL) as running, traffic(f"http://{running.http}", AGENTS):
        yield running


@pytest.fixture
def tab(browser: Browser, server: Server) -> Iterator[Console]:
    """The console with the scene in view, which must not report an error."""
    with scene(browser, server) as made:
        yield made
        assert made.faults == []


@contextmanager
def scene(browser: Browser, server: Server, **size: int) -> Iterator[Console]:
    """Open the console on the scene and wait until it moves."""
    with console(browser, f"http://{server.http}", **size) as made:
        made.open(f"#/scene/{SCENE}")
        made.wait_for_ticks()
        yield made


def test_64_agents_at_10_hz_are_drawn_tick_by_tick(browser: Browser, server: Server) -> None:
    with scene(browser, server, width=1920, height=1080) as tab:
        tab.page.select_option("#ellipses", "all")
        tab.page.keyboard.press("n")
        tab.wait_for_ticks()
        before = counts(tab)
        time.sleep(SECONDS)
        after = counts(tab)
    came, drawn = after["received"] - before["received"], after["drawn"] - before["drawn"]
    each_ms = (after["milliseconds"] - before["milliseconds"]) / drawn
    print(f"{came / SECONDS:.1f} ticks a second came, {drawn} of {came} were drawn, {each_ms:.1f} ms each")  # noqa: T201
    assert came >= 7 * SECONDS
    assert drawn >= 0.95 * came - 1
    assert after["dropped"] == 0


def test_it_survives_a_restart_of_the_server(browser: Browser, models: Path) -> None:
    address = f"127.0.0.1:{free_port()}"
    with traffic(f"http://{address}", 5), console(browser, f"http://{address}") as tab:
        with serving(models, http=address, default_model=MODEL):
            tab.open(f"#/scene/{SCENE}")
            tab.wait_for_ticks()
        expect(tab.page.locator("#link-text")).to_contain_text("Next try in")
        kept = tab.drawn()
        tab.page.keyboard.press(",")  # what was seen can still be looked at
        expect(tab.page.locator("#play")).to_have_text("Live")
        tab.page.keyboard.press("Space")
        with serving(models, http=address, default_model=MODEL):
            tab.page.wait_for_function("least => cabForecastConsole.counts.drawn > least + 10", arg=kept)
            expect(tab.page.locator("#link-text")).to_have_text("Live")
        assert all("Failed to load resource" in fault or "ERR_" in fault for fault in tab.faults)


def test_a_second_model_is_asked_for_the_same_tick(tab: Console) -> None:
    check_two_models(tab, f"{SECOND}@{VERSION}", f"{SECOND} {VERSION} ·")


def test_the_shadow_is_shown_on_the_same_tick(browser: Browser, models: Path) -> None:
    with (
        serving(models, default_model=MODEL, shadow=f"{SECOND}@{VERSION}:1") as running,
        traffic(f"http://{running.http}", 5, hertz=5.0),
        scene(browser, running) as tab,
    ):
        check_two_models(tab, "shadow", f"{SECOND} {VERSION} (shadow)")


def check_two_models(tab: Console, choice: str, caption: str) -> None:
    """Compare with a second model, and check that both pictures are of one tick."""
    page = tab.page
    page.get_by_role("option", name="vehicle-00").click()
    page.select_option("#compare", choice)
    expect(page.locator("#pane-b figcaption")).to_contain_text(caption)
    expect(page.locator("#pane-a figcaption")).to_contain_text(f"{MODEL} {VERSION}")
    expect(page.locator("#agent .modes thead")).to_contain_text(f"{SECOND} {VERSION}")
    seen = set()
    for _ in range(20):
        now = counts(tab)
        if now["secondTime"] is not None:
            assert now["secondTime"] == now["time"]
            seen.add(now["time"])
        time.sleep(0.1)
    assert len(seen) >= 5
    page.select_option("#compare", "")
    expect(page.locator("#pane-b")).to_be_hidden()


def test_samples_are_drawn_on_demand(tab: Console) -> None:
    tab.page.get_by_role("option", name="vehicle-00").click()
    tab.page.keyboard.press("Space")
    with tab.page.expect_response("**/v1/predict") as answer:
        tab.page.keyboard.press("s")
    [forecast] = answer.value.json()["forecasts"]
    assert forecast["agent_id"] == "vehicle-00"
    assert len(forecast["samples"]) == 100 * 12 * 2
    assert "scene_id" not in json.loads(answer.value.request.post_data or "")


def test_all_can_be_done_by_keyboard(tab: Console) -> None:
    page = tab.page
    press = page.keyboard.press
    press("?")
    expect(page.get_by_role("dialog")).to_contain_text("choose the next agent")
    press("Escape")
    expect(page.get_by_role("dialog")).to_have_count(0)

    press("n")
    first = tab.text("#agent h2")
    page.locator("#agent-list").focus()
    press("ArrowDown")
    expect(page.locator("#agent h2")).not_to_have_text(first)
    press("ArrowUp")
    expect(page.locator("#agent h2")).to_have_text(first)
    chosen = page.locator("#agent-list").get_attribute("aria-activedescendant")
    expect(page.locator(f"#{chosen}")).to_have_attribute("aria-selected", "true")
    press("f")
    expect(page.locator("#follow")).to_have_attribute("aria-pressed", "true")
    press("0")
    expect(page.locator("#follow")).to_have_attribute("aria-pressed", "false")
    press("/")
    page.keyboard.type("vehicle-00")
    expect(page.locator("#agent-count")).to_have_text(f"1 of {AGENTS}")
    press("Escape")

    page.locator("#time").focus()
    press("ArrowLeft")
    expect(page.locator("#play")).to_have_text("Live")
    at = tab.text("#clock").split(" ")[0]
    press("ArrowLeft")
    expect(page.locator("#clock")).not_to_contain_text(at)
    press("k")
    expect(page.locator("#play")).to_have_text("Pause")

    press("t")
    expect(page.locator("#theme")).to_have_text("Theme: light")
    press("t")
    expect(page.locator("html")).to_have_attribute("data-theme", "dark")
    press("h")
    expect(page.get_by_role("heading", name="Health of the service")).to_be_visible()
    press("l")
    expect(page.get_by_role("link", name=SCENE)).to_be_visible()
    page.get_by_role("link", name=SCENE).focus()
    press("Enter")
    expect(page.locator("#scene-title")).to_have_text(SCENE)


def test_a_key_is_asked_for_and_its_scopes_count(browser: Browser, models: Path, tmp_path: Path) -> None:
    secrets = {"reader": [Scope.READ], "planner": [Scope.READ, Scope.PREDICT]}
    keys = [Key(name=name, sha256=digest(name), scopes=tuple(scopes)) for name, scopes in secrets.items()]
    file = tmp_path / "keys.json"
    write_keys(file, keys)
    with (
        serving(models, default_model=MODEL, keys_file=file) as running,
        traffic(f"http://{running.http}", 5, token="planner"),  # noqa: S106
        console(browser, f"http://{running.http}") as tab,
    ):
        page = tab.page
        tab.open(f"#/scene/{SCENE}")
        enter(page, "wrong")
        expect(page.locator("#key-reason")).to_contain_text("does not accept this key")
        enter(page, "reader")
        tab.wait_for_ticks()
        expect(page.locator("#samples")).to_be_hidden()
        page.keyboard.press("h")
        expect(page.locator("#health-note")).to_contain_text("scope metrics")
        page.evaluate("sessionStorage.clear()")
        page.reload()
        enter(page, "planner")
        tab.open(f"#/scene/{SCENE}")
        tab.wait_for_ticks()
        expect(page.locator("#samples")).to_be_visible()


@pytest.fixture(scope="module")
def axe(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the code of axe-core, from npm."""
    folder = tmp_path_factory.mktemp("axe")
    command = [require("npm"), "install", "--silent", "--ignore-scripts", "--prefix", str(folder), AXE]
    subprocess.run(command, check=True, timeout=60)  # noqa: S603
    return (folder / "node_modules" / "axe-core" / "axe.min.js").read_text(encoding="utf-8")


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("where", ["#/scenes", "#/health", f"#/scene/{SCENE}", "help"])
def test_axe_finds_nothing_serious(tab: Console, axe: str, theme: str, where: str) -> None:
    page = tab.page
    page.emulate_media(color_scheme=theme)  # type: ignore[arg-type]  # one of the literals
    if where == "help":
        page.keyboard.press("?")
    else:
        tab.open(where)
        expect(page.locator("#link-text")).to_have_text("Live" if SCENE in where else "Connected")
    if SCENE in where:
        page.get_by_role("option", name="vehicle-00").click()
        page.locator("#key summary").click()
        page.select_option("#compare", f"{SECOND}@{VERSION}")
        expect(page.locator("#pane-b figcaption")).to_be_visible()
        page.keyboard.press("Space")
    if "health" in where:
        expect(page.locator(".figure b").first).to_be_visible()
    page.evaluate(axe)
    found = page.evaluate("async () => (await axe.run()).violations")
    assert [brief(each) for each in found if each["impact"] in ("serious", "critical")] == []


def brief(violation: dict[str, Any]) -> str:
    """Return a violation and the first elements that have it."""
    places = [f"{node['html'][:120]}: {node['failureSummary'][-200:]}" for node in violation["nodes"][:4]]
    return f"{violation['id']} ({violation['impact']}): {places}"


def counts(tab: Console) -> dict[str, Any]:
    """Return what the console counted."""
    found: dict[str, Any] = tab.page.evaluate("({...cabForecastConsole.counts})")
    return found


def enter(page: Page, key: str) -> None:
    """Give the key that the page asks for."""
    expect(page.get_by_role("dialog")).to_be_visible()
    page.get_by_label("Key", exact=True).fill(key)
    page.get_by_role("button", name="Use it").click()
