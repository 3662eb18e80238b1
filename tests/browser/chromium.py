"""Debian's Chromium, driven by Playwright; tests that want it skip where one of them is missing."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser

NAMES = ("chromium", "chromium-browser")
NO_PLAYWRIGHT = "the package playwright is missing: pip install 'amberbox[test]'"
NO_CHROMIUM = "chromium is missing: apt-get install chromium"
_ARGUMENTS = (
    "--no-sandbox",  # who runs tests in a container is root there
    "--disable-dev-shm-usage",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE localhost, EXCLUDE 127.0.0.1",
)


@contextmanager
def chromium() -> Iterator[Browser]:
    """Start a browser that reaches nothing but this machine; skip without one."""
    api = pytest.importorskip("playwright.sync_api", reason=NO_PLAYWRIGHT)
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip(NO_CHROMIUM)
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=list(_ARGUMENTS))
        try:
            yield browser
        finally:
            browser.close()
