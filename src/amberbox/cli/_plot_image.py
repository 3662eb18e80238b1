"""Draw a plot as an image (matplotlib)."""

from __future__ import annotations

import io
from datetime import UTC, datetime, tzinfo
from typing import Any

import numpy as np

from amberbox.cli._plot_curves import Curve, Drawing
from amberbox.core.errors import UsageError
from amberbox.core.types import IntArray

_PANEL_INCHES = 3.2
_GAP_COLOUR = "0.85"


def draw_image(plot: Drawing, kind: str) -> bytes:
    """Return the bytes of a PNG, SVG or PDF: one panel per unit, gaps shaded.

    Raises UsageError without matplotlib.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        hint = "pip install 'amberbox[plot]', or write an html file"
        raise UsageError(f"{kind} needs matplotlib", hint) from None
    units = plot.units()
    figure = Figure(figsize=(10, 0.8 + _PANEL_INCHES * len(units)), layout="constrained")
    panels = figure.subplots(len(units), 1, sharex=True, squeeze=False)[:, 0]
    for panel, unit in zip(panels, units, strict=True):
        _panel(panel, plot, [curve for curve in plot.curves if curve.unit == unit], unit)
    _time_axis(panels[-1], plot)
    panels[0].set_title(plot.title)
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=120)
    return buffer.getvalue()


def _panel(panel: Any, plot: Drawing, curves: list[Curve], unit: str) -> None:
    for curve in curves:
        panel.plot(_dates(curve.times_ns), curve.values, linewidth=1, label=curve.name)
    for number, (from_ns, to_ns, _) in enumerate(plot.gaps):
        label = "gap" if number == 0 else None
        edges = _dates(np.array([from_ns, to_ns]))
        panel.axvspan(edges[0], edges[1], color=_GAP_COLOUR, linewidth=0, label=label)
    panel.set_ylabel(unit)
    panel.grid(visible=True, alpha=0.3)
    panel.legend(loc="best", fontsize="small")


def _dates(times_ns: IntArray) -> Any:
    return times_ns.astype("datetime64[ns]")


def _time_axis(panel: Any, plot: Drawing) -> None:
    from matplotlib import dates

    library: Any = dates  # its classes come without types
    zone: tzinfo = UTC if not plot.local else _local_zone()
    locator = library.AutoDateLocator(tz=zone)
    panel.xaxis.set_major_locator(locator)
    panel.xaxis.set_major_formatter(library.ConciseDateFormatter(locator, tz=zone))
    name = "local time" if plot.local else "UTC"
    panel.set_xlabel(f"{plot.clock}, {name}")


def _local_zone() -> tzinfo:
    zone = datetime.now().astimezone().tzinfo
    return zone if zone is not None else UTC
