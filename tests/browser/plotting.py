"""A page with nothing but plots, of the site's own modules, styles and rules for browsers."""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING, Any

from amberbox.server.web.assets import address
from amberbox.server.web.text import for_browser

if TYPE_CHECKING:
    from playwright.sync_api import Page, Route

PATH = "/plots-alone"
ROBOT = "ropod_001"
ODOM, DRIVE = "ros_ropod_odom", "ros_ropod_drive"
SPEED = {"id": "speed", "robot": ROBOT, "item": ODOM, "variable": "twist_linear_x",
         "label": "Speed", "unit": "m/s"}  # fmt: skip
STATE = {"id": "state", "robot": ROBOT, "item": DRIVE, "variable": "state", "label": "State",
         "labels": {"0": "IDLE", "1": "DRIVING", "2": "BLOCKED"}, "kind": "enum"}  # fmt: skip
ENABLED = {"id": "enabled", "robot": ROBOT, "item": DRIVE, "variable": "enabled",
           "label": "Enabled", "kind": "bool"}  # fmt: skip
REMARK = {"id": "remark", "robot": ROBOT, "item": DRIVE, "variable": "remark",
          "label": "Remark", "kind": "text"}  # fmt: skip
VOLTS = {"id": "volts", "robot": ROBOT, "item": "battery", "variable": "volts",
         "label": "Voltage", "unit": "V"}  # fmt: skip
CHARGE = {"id": "charge", "robot": ROBOT, "item": "battery", "variable": "charge_percent",
          "label": "Charge", "unit": "%", "panel": "volts"}  # fmt: skip
MINUTE = 60.0

_RULES = "default-src 'self'; script-src 'self'; style-src 'self'; img-src 'self' data:"
_HTML = """<!doctype html>
<html lang="en" data-feed="none"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="csrf" content=""><meta name="now" content="{now}"><title>Plots</title>
<link rel="icon" href="{icon}" type="image/svg+xml"><link rel="stylesheet" href="{style}">
<script type="application/json" id="strings">{strings}</script><script src="{uplot}"></script>
</head><body><main id="content"><h1>Plots</h1><div id="place"></div></main>
<div id="toasts"></div></body></html>"""


def open_plots(
    page: Page, from_s: float, to_s: float, *traces: dict[str, Any], **more: Any
) -> None:
    """Show variables over a window; ``stack`` is the page's name of the plots."""
    page.route(f"**{PATH}", _answer)
    page.goto(PATH)
    page.evaluate(
        """async ([module, options, traces]) => {
            const { plots } = (await import(module)).$need("plot/plot.js");
            window.heard = [];
            window.stack = plots(document.getElementById("place"),
              {...options, onWindow: (...w) => window.heard.push(w)});
            window.drawn = [];
            document.addEventListener("plotdrawn", (e) => window.drawn.push(e.detail.id));
            traces.forEach(window.stack.add);
        }""",
        [address("all.js"), {"from": from_s, "to": to_s, **more}, list(traces)],
    )
    settle(page)


def settle(page: Page) -> None:
    """Wait until everything in the window is loaded."""
    page.wait_for_function("() => window.stack.now().settled")


def now(page: Page) -> dict[str, Any]:
    """The state of the plots: window, cursor, and the points drawn of each variable."""
    found: dict[str, Any] = page.evaluate(
        """() => {
            const { from, to, cursor, traces } = window.stack.now();
            const of = ({series}) => series && {points: series.x.length, of: series.of,
              envelope: series.envelope, low: Math.min(...series.low.filter((v) => !isNaN(v))),
              high: Math.max(...series.high.filter((v) => !isNaN(v)))};
            return {from, to, cursor, drawn: Object.fromEntries(traces.map((t) => [t.id, of(t)]))};
        }"""
    )
    return found


def drag(page: Page, first: float, last: float, panel: int = 0) -> None:
    """Draw the mouse over a part of a panel, from one share of its width to another."""
    box = page.locator(".plot-canvas .u-over").nth(panel).bounding_box()
    assert box is not None
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + first * box["width"], y)
    page.mouse.down()
    page.mouse.move(box["x"] + last * box["width"], y, steps=3)
    page.mouse.up()


def point(page: Page, share: float, panel: int = 0) -> None:
    """Put the mouse onto a panel."""
    box = page.locator(".plot-canvas .u-over").nth(panel).bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + share * box["width"], box["y"] + box["height"] / 2)


def _answer(route: Route) -> None:
    strings = json.dumps(dict(for_browser(("common", "plot"))))
    stamp = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    html = _HTML.format(
        now=stamp, icon=address("icons.svg"), style=address("site.css"), strings=strings,
        uplot=address("vendor/uplot.js"),
    )  # fmt: skip
    route.fulfill(body=html, content_type="text/html", headers={"Content-Security-Policy": _RULES})
