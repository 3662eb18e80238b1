"""Debian's Chromium, driven by Playwright; tests that need it skip where one of them is missing."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, ProxySettings

NAMES = ("chromium", "chromium-browser")
NO_PLAYWRIGHT = "the package playwright is missing: pip install 'amberbox[test]'"
NO_CHROMIUM = "chromium is missing: apt-get install chromium"
_NOWHERE = "http://127.0.0.1:9"
_ARGUMENTS = (
    "--no-sandbox",  # who runs tests in a container is root there
    "--disable-dev-shm-usage",
)


@contextmanager
def chromium() -> Iterator[Browser]:
    """Start a browser; skip without one."""
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


def only(url: str) -> ProxySettings:
    """Return what lets a context reach one server: all others are behind a proxy that is not."""
    return {"server": _NOWHERE, "bypass": f"<-loopback>,{urlsplit(url).netloc}"}
