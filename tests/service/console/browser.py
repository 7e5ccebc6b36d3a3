"""Chromium, driven by Playwright, with what goes wrong on a page."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from playwright.sync_api import Browser, ConsoleMessage, Page, sync_playwright

NAME = "chromium"
MISSING = f"{NAME} is not installed; Debian has it: apt-get install {NAME}"
TIMEOUT_MS = 15_000


def chromium() -> str | None:
    """Return the path of the system's Chromium; None: there is none."""
    return shutil.which(NAME)


@contextmanager
def launched(path: str) -> Iterator[Browser]:
    """Run the browser while the context lasts."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path)
        try:
            yield browser
        finally:
            browser.close()


@dataclass
class Console:
    """The console in one tab of the browser."""

    page: Page
    url: str
    faults: list[str] = field(default_factory=list)
    """Exceptions and errors that the page reported."""

    def open(self, where: str = "#/scenes") -> None:
        """Open one of its pages."""
        self.page.goto(f"{self.url}/{where}")

    def drawn(self) -> int:
        """Return how many ticks were drawn."""
        return int(self.page.evaluate("cabForecastConsole.counts.drawn"))

    def received(self) -> int:
        """Return how many ticks came."""
        return int(self.page.evaluate("cabForecastConsole.counts.received"))

    def wait_for_ticks(self, more: int = 5) -> None:
        """Wait until more ticks were drawn."""
        self.page.wait_for_function(
            "least => cabForecastConsole.counts.drawn >= least", arg=self.drawn() + more
        )

    def text(self, selector: str) -> str:
        """Return the text of an element."""
        return self.page.locator(selector).inner_text()


@contextmanager
def console(browser: Browser, url: str, *, width: int = 1280, height: int = 800) -> Iterator[Console]:
    """Open a tab of its own, without anything kept.

    Args:
        browser: the browser.
        url: of the server.
        width: of the window, pixels.
        height: of the window, pixels.
    """
    with browser.new_context(viewport={"width": width, "height": height}) as context:
        context.set_default_timeout(TIMEOUT_MS)
        made = Console(context.new_page(), url)

        def on_console(message: ConsoleMessage) -> None:
            if message.type == "error":
                made.faults.append(message.text)

        made.page.on("console", on_console)
        made.page.on("pageerror", lambda error: made.faults.append(str(error)))
        yield made
