"""A report in a real Chromium: the system's browser, pages that note whatever goes wrong, waits with a limit."""

import json
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page

BROWSERS = ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"]
BROWSER_ARGUMENTS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
HEIGHT = 900
# Longest wait for something that takes a moment on a machine with nothing else to do.
WAIT_MS = 60_000
LOOK_MS = 20


def find_browser() -> str:
    """The browser of this machine; none is ever downloaded."""
    for name in BROWSERS:
        path = shutil.which(name)
        if path is not None:
            return path
    sys.exit(
        f"no browser found (tried {', '.join(BROWSERS)}); install it with: sudo apt-get install -y chromium"
    )


class Report:
    """A report's folder, and pages of it in a browser that note whatever goes wrong."""

    def __init__(self, browser: Browser, folder: Path) -> None:
        self.browser = browser
        self.index = (folder / "index.html").resolve().as_uri()
        text = (folder / "data" / "catalogue.js").read_text(encoding="utf-8")
        self.catalogue: dict[str, Any] = json.loads(
            text.removeprefix("window.reverCatalogue = ").removesuffix(";\n")
        )

    def episodes_of(self, setting: int) -> list[dict[str, Any]]:
        """The episodes of one setting, in the order of the list."""
        pairs = self.catalogue["pairs"]
        return [
            e for pair in pairs for e in pair["episodes"] if e["setting"] == setting
        ]

    @contextmanager
    def page(self, link: str = "", width: int = 1440, **options: Any) -> Iterator[Page]:
        """Opens the page; at the end nothing may have gone wrong in it."""
        context = self.browser.new_context(
            viewport={"width": width, "height": HEIGHT},
            accept_downloads=True,
            **options,
        )
        context.set_default_timeout(WAIT_MS)
        page = context.new_page()
        wrong: list[str] = []
        page.on(
            "console",
            lambda said: wrong.append(said.text) if said.type != "log" else None,
        )
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on(
            "request",
            lambda request: (
                None
                if request.url.startswith(("file:", "data:", "blob:"))
                else wrong.append(f"asks for {request.url}")
            ),
        )
        page.goto(self.index + link)
        if options.get("java_script_enabled", True):
            page.wait_for_selector("#cards button")
        try:
            yield page
        finally:
            context.close()
        assert not wrong, f"the page complains: {wrong}"

    def result(self, pair: dict[str, Any]) -> str | None:
        """What the list calls a pair's result; worked out here a second time."""
        left, right = self.catalogue["compared"]
        outcomes = {entry["setting"]: entry["outcome"] for entry in pair["episodes"]}
        sides = [outcomes.get(left), outcomes.get(right)]
        if any(side in (None, "fault", "none") for side in sides):
            return None
        won = [side == "success" for side in sides]
        return {(True, False): "won", (False, True): "lost", (True, True): "both"}.get(
            (won[0], won[1]), "neither"
        )


def step_of(page: Page) -> int:
    return int(page.input_value("#scrubber"))


def wait_for(page: Page, condition: str) -> None:
    """Looks at a condition until it holds: the page's own policy forbids playwright to look from within."""
    deadline = time.monotonic() + WAIT_MS / 1000
    while not page.evaluate(condition):
        assert time.monotonic() < deadline, (
            f"waited {WAIT_MS / 1000:.0f} s for {condition}"
        )
        page.wait_for_timeout(LOOK_MS)


def frames(page: Page) -> list[int]:
    """The frame that each video shows."""
    return page.evaluate(
        "[...document.querySelectorAll('.stage video')].map((video) =>"
        " Math.floor(video.currentTime * window.reverCatalogue.frames_per_second))"
    )


def number(text: str) -> float:
    return float(text.replace("−", "-").replace("+", "").replace("pp", ""))
