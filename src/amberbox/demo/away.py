"""A robot that is away for a while: it is seen to go and to come back, and nothing is lost."""

from __future__ import annotations

import time
from typing import Any

from amberbox.core.timetext import format_time
from amberbox.demo.browser import Browser
from amberbox.demo.listening import Heard, Listener
from amberbox.demo.robots import SOMETIMES_AWAY
from amberbox.demo.telling import PATIENCE_S, Telling, until

_ITEM = "sim_odom"
_RATE_HZ, _MOST_OF_IT = 50, 0.8
_LEAST_LANES = 50


def watch_the_absence(telling: Telling, browser: Browser, feed: Listener) -> None:
    """See the robot go and come back, and what it recorded meanwhile arrive."""
    went = feed.wait(_is_presence(online=False), PATIENCE_S)
    telling.worked(f"{SOMETIMES_AWAY} went offline")
    came = feed.wait(_is_presence(online=True), PATIENCE_S, went.at_s)
    telling.worked(f"{SOMETIMES_AWAY} came back after {came.at_s - went.at_s:.0f} s")
    span = {"from": _time_of(went), "to": _time_of(came)}
    count = until(lambda: _lanes(browser, span), lambda: "what it found meanwhile is here")
    telling.worked(f"{SOMETIMES_AWAY} has told how {count} parts of it were meanwhile")
    least = round((came.at_s - went.at_s) * _RATE_HZ * _MOST_OF_IT)
    rows = until(lambda: _rows(browser, span, least), lambda: "what was recorded meanwhile is here")
    telling.worked(f"{rows} rows of {_ITEM} of that time are here")


def _is_presence(*, online: bool) -> Any:
    def is_it(heard: Heard) -> bool:
        is_his = (heard.kind, heard.robot) == ("presence", SOMETIMES_AWAY)
        return is_his and heard.data["online"] is online

    return is_it


def _lanes(browser: Browser, span: dict[str, str]) -> int | None:
    """Count the components and modes that are known to have been well in a span of time."""
    path = f"/robots/{SOMETIMES_AWAY}/timeline?from={span['from']}&to={span['to']}"
    lanes = browser.get(path)["lanes"]
    well = [lane for lane in lanes if any(one["level"] == "ok" for one in lane["stretches"])]
    return len(well) if len(well) >= _LEAST_LANES else None


def _rows(browser: Browser, span: dict[str, str], least: int) -> int | None:
    path = f"/robots/{SOMETIMES_AWAY}/query?item={_ITEM}&from={span['from']}&to={span['to']}"
    answer = browser.get_data(path)
    found = int(answer["rows"]) if answer else 0
    return found if found >= least else None


def _time_of(heard: Heard) -> str:
    """Return when something was heard by the clock on the wall, which all of them share here."""
    return format_time(time.time_ns() - round((time.monotonic() - heard.at_s) * 1e9))
