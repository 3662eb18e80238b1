"""Playwright's ``expect``; modules that import it are skipped where Playwright is missing."""

from __future__ import annotations

import pytest

from tests.browser.chromium import NO_PLAYWRIGHT

pytest.importorskip("playwright.sync_api", reason=NO_PLAYWRIGHT)

from playwright.sync_api import expect  # only where it is there

expect.set_options(timeout=10_000)

__all__ = ["expect"]
