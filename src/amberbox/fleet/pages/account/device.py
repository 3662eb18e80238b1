"""With what somebody is signed in, in words: browsers say it in a line that nobody can read."""

from __future__ import annotations

import re
from collections.abc import Sequence

from amberbox.fleet.pages.strings import catalogue

_BROWSERS = (
    ("Edg", "Edge"), ("OPR", "Opera"), ("SamsungBrowser", "Samsung Internet"),
    ("Firefox", "Firefox"), ("FxiOS", "Firefox"), ("Chromium", "Chromium"),
    ("HeadlessChrome", "Chrome"), ("CriOS", "Chrome"), ("Chrome", "Chrome"), ("Safari", "Safari"),
)  # fmt: skip
"""Products by their mark, those first whose line also has the marks of later ones."""
_SYSTEMS = (
    ("Android", "Android"), ("iPhone", "iPhone"), ("iPad", "iPad"), ("CrOS", "ChromeOS"),
    ("Windows", "Windows"), ("Mac OS X", "macOS"), ("Linux", "Linux"),
)  # fmt: skip
_PROGRAM = re.compile(r"[\w.+-]{1,40}")


def device(agent: str) -> str:
    """Return browser and system of a ``User-Agent``; of a program its name."""
    text = catalogue().text
    browser, system = _first(_BROWSERS, agent, "/"), _first(_SYSTEMS, agent)
    if browser and system:
        return text("account.sessions.device", browser=browser, system=system)
    program = _PROGRAM.match(agent)
    return browser or (program[0] if program else text("account.sessions.unknown"))


def _first(known: Sequence[tuple[str, str]], agent: str, end: str = "") -> str:
    return next((name for mark, name in known if mark + end in agent), "")
