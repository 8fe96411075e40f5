"""A real, headless browser for tests of pages; they skip where there is none."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@contextmanager
def launch() -> Iterator[Any]:
    """Start Chromium, or skip."""
    reason = "needs Playwright: pip install playwright"
    if hasattr(os, "sched_setscheduler"):  # what an encoder in this process may have changed
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    api = pytest.importorskip("playwright.sync_api", reason=reason)
    with api.sync_playwright() as playwright:
        path = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
        if path is None and not Path(playwright.chromium.executable_path).exists():
            pytest.skip("needs Chromium: apt-get install chromium, or playwright install chromium")
        # The pages are this project's own, and in a container there may be no sandbox.
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def open_page(browser: Any, path: Path) -> Iterator[Any]:
    """Open a file; `problems` of the page are all that its console says, `requests` its fetches."""
    page = browser.new_page(viewport={"width": 1360, "height": 900})
    page.problems, page.requests = [], []
    page.on("console", lambda message: page.problems.append(message.text))
    page.on("pageerror", lambda error: page.problems.append(str(error)))
    page.on(
        "request",
        lambda request: (
            None if request.url.startswith("data:") else page.requests.append(request.url)
        ),
    )
    page.set_default_timeout(20_000)
    try:
        page.goto(path.as_uri())
        yield page
    finally:
        page.close()
