"""Playwright's ``expect``; modules that import it are skipped where Playwright is missing."""

from __future__ import annotations

import pytest

from tests.browser.chromium import NO_PLAYWRIGHT

pytest.importorskip("playwright.sync_api", reason=NO_PLAYWRIGHT)

from playwright.sync_api import expect  # only where it is there

PATIENCE_MS = 60_000
"""How long an event may take on a busy machine before a test gives up."""

expect.set_options(timeout=PATIENCE_MS)

__all__ = ["PATIENCE_MS", "expect"]
