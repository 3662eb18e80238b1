"""Take the data of the fault home: the rows of the plot, and a file of what the view shows."""

from __future__ import annotations

from typing import Any

from amberbox.core.clock import NS
from amberbox.core.timetext import format_time
from amberbox.demo.browser import Browser
from amberbox.demo.telling import Telling, check, until

ITEM, VARIABLE = "sim_bus", "working_counter"
WELL, BROKEN = 12, 9
"""What the fieldbus counts with all units there, and with one of them gone."""
_AROUND_NS = 5 * NS


def take_home(telling: Telling, browser: Browser, robot: str, broken_ns: int) -> None:
    """See the fault in the data around it, and download that view as CSV."""
    window = {
        "from": format_time(broken_ns - _AROUND_NS),
        "to": format_time(broken_ns + _AROUND_NS),
    }
    rows = until(lambda: _rows(browser, robot, window), lambda: "the data of the fault are here")
    telling.worked(f"{rows} rows of {ITEM}.{VARIABLE} show the fault: {WELL}, then {BROKEN}")
    asked = {"robots": [robot], "items": [ITEM], "variables": {ITEM: [VARIABLE]}, **window}
    number = browser.send("POST", "/downloads", {**asked, "format": "csv"})["id"]
    made = until(lambda: _made(browser, number), lambda: "the download is made")
    text = browser.fetch(f"/downloads/{number}/file").decode()
    check(f",{BROKEN}" in text and f",{WELL}" in text, "the file shows the fault as well")
    telling.worked(f"downloaded {made['file']}: {len(text.splitlines()) - 1} rows")


def _rows(browser: Browser, robot: str, window: dict[str, str]) -> int | None:
    """Count the rows once both values are among them: journals come when they are closed."""
    span = f"from={window['from']}&to={window['to']}"
    answer = browser.get_data(f"/robots/{robot}/query?item={ITEM}&variables={VARIABLE}&{span}")
    if answer is None:
        return None
    names = [column["name"] for column in answer["columns"]]
    at = names.index(VARIABLE) if VARIABLE in names else -1
    values = {row[at] for row in answer["data"]}
    return int(answer["rows"]) if {WELL, BROKEN} <= values else None


def _made(browser: Browser, number: str) -> Any:
    job = browser.get(f"/downloads/{number}")
    check(job["state"] not in ("failed", "cancelled", "expired"), f"it is made: {job['error']}")
    return job if job["state"] == "done" else None
