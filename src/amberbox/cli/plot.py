"""Draw variables over time: PNG, SVG or PDF, or an HTML page with zoom that needs no network."""

from __future__ import annotations

import argparse
import html
import io
import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amberbox.blackbox.columns.arrays import null_mask
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.query.table import Table, downsample
from amberbox.cli._arguments import add_range, add_where, add_window, opened, window_of
from amberbox.cli._output import print_notes, writable
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.notes import RecordedNote
from amberbox.core.timestamps import format_time
from amberbox.core.types import Column, Gap, IntArray, Ragged

_HOLE_FACTOR = 10
_HOLE_NS = NS


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """One variable: NaN where it is missing or where the line has to break."""

    name: str
    unit: str
    times_ns: IntArray
    values: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class RecordPlot:
    """The data of a plot; ``clock`` names the clock of the time axis."""

    title: str
    clock: str
    local: bool
    curves: tuple[Curve, ...]
    gaps: tuple[tuple[int, int, str], ...]
    rows: int
    notes: tuple[str, ...]
    remarks: tuple[tuple[int, int, str], ...] = ()
    """Notes of people on the item, or on nothing particular: begin, end (ns) and text."""

    def units(self) -> list[str]:
        """Return the units in use; each has a panel of its own."""
        return list(dict.fromkeys(curve.unit for curve in self.curves))


def drawing(record: Record, args: argparse.Namespace) -> RecordPlot:
    """Query the data of a plot.

    Raises UsageError for variables that are not numeric, AmberboxError for an empty range.
    """
    if args.points < 1:
        raise UsageError("--points must be 1 or more")
    span = window_of(args, record)
    named = [*args.variables, "received"]
    table, is_whole = record.drawn(args.item, named, span, args.by, args.points)
    if not len(table):
        raise AmberboxError(
            f"{table.item} has no rows in this range", "amberbox items shows its times"
        )
    fields = [f for f in table.fields if f.name not in ("timestamp", "received")]
    times = np.asarray(table["received" if args.by == "received" else "timestamp"])
    gaps = gaps_in_plot(record, table.item, times)
    holes = _holes(times) if is_whole else np.empty(0, np.int64)  # thinned rows are uneven
    shown, breaks = _shown_rows(table, fields, (times, holes), gaps, args.points)
    curves = tuple(_curve(table, field, times, shown, breaks) for field in fields)
    clock = "time of receipt" if args.by == "received" else "own time stamps"
    remarks = _remarks(record, table.item, times)
    return RecordPlot(table.item, clock, args.local, curves, gaps, len(table), table.notes, remarks)


def _remarks(record: Record, item: str, times: IntArray) -> tuple[tuple[int, int, str], ...]:
    first, last = int(times.min()), int(times.max())
    notes: Sequence[RecordedNote] = ()
    with suppress(AmberboxError):  # on a server the caller may not be allowed to read them
        notes = record.annotations(first, last + 1)
    return tuple(
        (max(note.at_ns, first), min(note.to_ns or note.at_ns, last), f"{note.text} ({note.who})")
        for note in notes
        if note.about.partition(".")[0] in ("", item)
    )


def gaps_in_plot(record: Record, item: str, times: IntArray) -> tuple[tuple[int, int, str], ...]:
    """Return begin, end (ns) and reason of the gaps between the first and the last time."""
    first, last = int(times.min()), int(times.max())
    known = [gap for gap in record.gaps(item, first, last + 1) if not _is_of_one(gap, times)]
    found = [(max(gap.from_ns, first), min(gap.to_ns, last), gap.reason) for gap in known]
    return tuple(gap for gap in found if gap[1] > gap[0])


def _is_of_one(gap: Gap, times: IntArray) -> bool:
    """Return whether only one publisher was missing, while others were recorded."""
    return bool(gap.peer and ((times >= gap.from_ns) & (times < gap.to_ns)).any())


def _shown_rows(
    table: Table,
    fields: list[Column],
    rows: tuple[IntArray, IntArray],
    gaps: tuple[tuple[int, int, str], ...],
    points: int,
) -> tuple[IntArray, IntArray]:
    """Return the rows to draw, and those of them after which the line breaks."""
    times, breaks = rows
    for from_ns, to_ns, _ in gaps:
        before = int(np.searchsorted(times, (from_ns + to_ns) // 2)) - 1
        breaks = np.append(breaks, before)
    breaks = np.unique(breaks[(breaks >= 0) & (breaks < len(times) - 1)])
    thinned = downsample([table[field.name] for field in fields], len(times), points)
    return np.unique(np.concatenate((thinned, breaks, breaks + 1))), breaks


def _holes(times: IntArray) -> IntArray:
    """Return the rows that are followed by a pause much longer than usual."""
    steps = np.diff(times)
    if not len(steps):
        return np.empty(0, np.int64)
    usual = max(float(np.median(steps)) * _HOLE_FACTOR, _HOLE_NS)
    return np.flatnonzero(steps > usual)


def _curve(
    table: Table, field: Column, times: IntArray, shown: IntArray, breaks: IntArray
) -> Curve:
    column = table[field.name]
    if isinstance(column, Ragged) or column.dtype == object:
        element = f"; name an element: {field.name}[0]" if field.type.startswith("list<") else ""
        raise UsageError(f"{field.name} is {field.type}, not a number", f"plot numbers{element}")
    values = np.ma.getdata(column).astype(np.float64)
    values[null_mask(column)] = np.nan
    places = np.searchsorted(shown, breaks) + 1
    return Curve(
        field.name,
        field.unit,
        np.insert(times[shown], places, times[breaks] + 1),
        np.insert(values[shown], places, np.nan),
    )


_PANEL_INCHES = 3.2
_GAP_COLOUR = "0.85"
_NOTE_COLOUR = "tab:orange"
_NOTE_LENGTH = 80  # characters of a note in an image


def draw_image(plot: RecordPlot, kind: str) -> bytes:
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


def _panel(panel: Any, plot: RecordPlot, curves: list[Curve], unit: str) -> None:
    for curve in curves:
        panel.plot(_dates(curve.times_ns), curve.values, linewidth=1, label=curve.name)
    for number, (from_ns, to_ns, _) in enumerate(plot.gaps):
        label = "gap" if number == 0 else None
        edges = _dates(np.array([from_ns, to_ns]))
        panel.axvspan(edges[0], edges[1], color=_GAP_COLOUR, linewidth=0, label=label)
    for number, (from_ns, to_ns, text) in enumerate(plot.remarks):
        edges = _dates(np.array([from_ns, to_ns]))
        panel.axvspan(edges[0], edges[1], color=_NOTE_COLOUR, alpha=0.3, linewidth=1)
        panel.annotate(
            " ".join(text.split())[:_NOTE_LENGTH], (edges[0], 1.0 - 0.07 * (number % 10)),
            xycoords=("data", "axes fraction"), fontsize="x-small", va="top",
            parse_math=False,
        )  # fmt: skip
    panel.set_ylabel(unit)
    panel.grid(visible=True, alpha=0.3)
    panel.legend(loc="best", fontsize="small")


def _dates(times_ns: IntArray) -> Any:
    return times_ns.astype("datetime64[ns]")


def _time_axis(panel: Any, plot: RecordPlot) -> None:
    from matplotlib import dates

    library: Any = dates  # its classes are untyped
    zone: tzinfo = UTC if not plot.local else _local_zone()
    locator = library.AutoDateLocator(tz=zone)
    panel.xaxis.set_major_locator(locator)
    panel.xaxis.set_major_formatter(library.ConciseDateFormatter(locator, tz=zone))
    name = "local time" if plot.local else "UTC"
    panel.set_xlabel(f"{plot.clock}, {name}")


def _local_zone() -> tzinfo:
    zone = datetime.now().astimezone().tzinfo
    return zone if zone is not None else UTC


def draw_page(plot: RecordPlot) -> bytes:
    """Return the HTML page. Times are seconds after ``t0``, an RFC 3339 text."""
    t0 = min(int(curve.times_ns[0]) for curve in plot.curves)
    data = {
        "t0": format_time(t0),
        "clock": plot.clock,
        "local": plot.local,
        "panels": [
            {"unit": unit, "curves": [_curve_json(c, t0) for c in plot.curves if c.unit == unit]}
            for unit in plot.units()
        ],
        "gaps": [
            [(from_ns - t0) / NS, (to_ns - t0) / NS, reason] for from_ns, to_ns, reason in plot.gaps
        ],
        "notes": [
            [(from_ns - t0) / NS, (to_ns - t0) / NS, text] for from_ns, to_ns, text in plot.remarks
        ],
    }
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    template = files("amberbox.cli").joinpath("plot_page.html").read_text("utf-8")
    page = template.replace("{{count}}", str(len(plot.units())))
    return page.replace("{{title}}", html.escape(plot.title)).replace("{{data}}", text).encode()


def _curve_json(curve: Curve, t0: int) -> dict[str, Any]:
    return {
        "name": curve.name,
        "x": np.round((curve.times_ns - t0) / NS, 9).tolist(),
        "y": _finite(curve.values),
    }


def _finite(values: NDArray[np.float64]) -> list[float | None]:
    """Return values for JSON, with None for NaN and infinity, which break the line."""
    return [
        value if ok else None
        for value, ok in zip(values.tolist(), np.isfinite(values), strict=True)
    ]


_DRAW: dict[str, Callable[[RecordPlot], bytes]] = {
    "html": draw_page,
    "png": lambda plot: draw_image(plot, "png"),
    "svg": lambda plot: draw_image(plot, "svg"),
    "pdf": lambda plot: draw_image(plot, "pdf"),
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    add_where(parser, "robot folder, store or recording file")
    parser.add_argument("item", metavar="ITEM", help="data item; 'amberbox items' lists them")
    parser.add_argument("variables", metavar="VAR", nargs="+", help="as for 'amberbox query'")
    add_range(parser)
    add_window(parser)
    parser.add_argument(
        "--points", type=int, default=4000, metavar="N",
        help="draw at most N rows, keeping extremes (default: 4000)",
    )  # fmt: skip
    parser.add_argument("--local", action="store_true", help="times of this computer's zone")
    parser.add_argument(
        "-o", "--output", metavar="FILE", required=True, help="file ending in html, png, svg or pdf"
    )


def run(args: argparse.Namespace) -> int:
    """Draw and write the file."""
    kind = args.output.rpartition(".")[2].lower()
    if kind not in _DRAW:
        raise UsageError(f"cannot draw to {args.output}", "end the name in html, png, svg or pdf")
    target = writable(args.output)
    with opened(args.where) as record:
        plot = drawing(record, args)
    target.write_bytes(_DRAW[kind](plot))
    print_notes(plot.notes)
    print(f"{target}: {len(plot.curves)} curves over {plot.rows} rows")
    return 0
