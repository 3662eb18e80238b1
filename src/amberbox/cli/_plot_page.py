"""Draw a plot as one HTML page that works without a network: hover, zoom, pan."""

from __future__ import annotations

import html
import json
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.cli._plot_curves import Curve, Drawing
from amberbox.core.clock import NS
from amberbox.core.timetext import format_time


def draw_page(plot: Drawing) -> bytes:
    """Return the page. Times are seconds after ``t0``, an RFC 3339 text."""
    t0 = min(int(curve.times_ns[0]) for curve in plot.curves)
    data = {
        "t0": format_time(t0),
        "clock": plot.clock,
        "local": plot.local,
        "panels": [
            {"unit": unit, "curves": [_curve(c, t0) for c in plot.curves if c.unit == unit]}
            for unit in plot.units()
        ],
        "gaps": [
            [(from_ns - t0) / NS, (to_ns - t0) / NS, reason] for from_ns, to_ns, reason in plot.gaps
        ],
    }
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    template = files("amberbox.cli").joinpath("plot_page.html").read_text("utf-8")
    page = template.replace("{{count}}", str(len(plot.units())))
    return page.replace("{{title}}", html.escape(plot.title)).replace("{{data}}", text).encode()


def _curve(curve: Curve, t0: int) -> dict[str, Any]:
    return {
        "name": curve.name,
        "x": np.round((curve.times_ns - t0) / NS, 9).tolist(),
        "y": _finite(curve.values),
    }


def _finite(values: NDArray[np.float64]) -> list[float | None]:
    """JSON has no NaN and no infinity: both break the line."""
    return [
        value if ok else None
        for value, ok in zip(values.tolist(), np.isfinite(values), strict=True)
    ]
