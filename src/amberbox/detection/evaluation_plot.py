"""Plots of an evaluation: scores with their threshold, labelled faults, and alarms, over time.

An HTML page that needs no network and runs no script, or an image by matplotlib. Stretches of the
record without scores for a minute are cut out: each part has a drawing of its own.
"""

from __future__ import annotations

import io
import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.svg import SvgElement, element, escape_text, number, root, title
from amberbox.core.timestamps import format_time, format_to_second
from amberbox.detection.alarms import DetectorAlarm
from amberbox.detection.evaluation import Evaluation, EvaluationRow
from amberbox.detection.labels import FaultLabel
from amberbox.detection.record_detection import Detected

KINDS = ("html", "png", "svg", "pdf")
_APART_S = 60.0
_MOST_PARTS = 40
_MOST_ALARMS = 200
_MOST_POINTS = 1400
_LEAST, _MOST = 0.01, 100.0
_TICKS = (0.01, 0.1, 1.0, 10.0, 100.0)
_WIDE, _HIGH, _LEFT, _TOP, _BOTTOM = 900.0, 130.0, 60.0, 8.0, 20.0


@dataclass
class PlotData:
    """What a plot shows; ``follow`` collects it while an evaluation reads what was found.

    Scores are multiples of their thresholds, the worst of each second by detector, with the time in
    seconds since the Unix epoch.
    """

    labels: Sequence[FaultLabel]
    scores: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: defaultdict(list))
    alarms: list[DetectorAlarm] = field(default_factory=list)

    def follow(self, found: Iterable[Detected]) -> Iterator[Detected]:
        """Yield what was found, and keep what is drawn of it."""
        lasting: dict[tuple[str, str], int] = {}
        for one in found:
            if not isinstance(one, DetectorAlarm):
                self.scores[one.detector].append((one.at_ns / NS, one.score))
            elif one.gone_ns is None:
                lasting[one.detector, one.series] = len(self.alarms)
                self.alarms.append(one)
            elif (place := lasting.pop((one.detector, one.series), None)) is not None:
                self.alarms[place] = one
            yield one

    def parts(self) -> list[tuple[float, float]]:
        """Return begin and end (s) of the stretches that have scores, at most 40."""
        times = sorted({at_s for scores in self.scores.values() for at_s, _ in scores})
        found: list[tuple[float, float]] = []
        for at_s in times:
            if found and at_s - found[-1][1] <= _APART_S:
                found[-1] = found[-1][0], at_s
            else:
                found.append((at_s - 1, at_s))
        return found[:_MOST_PARTS]

    def curve(self, detector: str, part: tuple[float, float]) -> list[tuple[float, float]]:
        """Return the scores of a detector in a part, thinned to the greatest of neighbours."""
        within = [one for one in self.scores[detector] if part[0] <= one[0] <= part[1]]
        step = math.ceil(len(within) / _MOST_POINTS) or 1
        return [max(within[at : at + step], key=_score) for at in range(0, len(within), step)]


def _score(point: tuple[float, float]) -> float:
    return point[1]


def draw(data: PlotData, judged: Evaluation, heading: str, kind: str) -> bytes:
    """Return the plot as a file of one of ``KINDS``.

    Raises UsageError for another kind, and for an image without matplotlib.
    """
    if kind not in KINDS:
        raise UsageError(f"cannot draw a plot as '{kind}'", f"one of {', '.join(KINDS)}")
    return _page(data, judged, heading) if kind == "html" else _image(data, heading, kind)


_STYLE = """
:root { color-scheme: light dark; --ink: #1c1f23; --paper: #fff; --dim: #5b6470; --line: #d5d9de;
  --curve: #0b62b8; --limit: #c62828; --fault: #f3d9a4; --alarm: #c62828; }
@media screen and (prefers-color-scheme: dark) { :root { --ink: #e6e8ea; --paper: #16191d;
  --dim: #9aa4b0; --line: #3a414a; --curve: #6cb2ff; --limit: #ff7b72;
  --fault: #5a4620; --alarm: #ff7b72; } }
body { font: 15px/1.45 system-ui, sans-serif; color: var(--ink); background: var(--paper);
  max-width: 64rem; margin: 0 auto; padding: 1.5rem 1rem; overflow-wrap: anywhere; }
h2 { margin: 2rem 0 .5rem; border-bottom: 1px solid var(--line); } .dim { color: var(--dim); }
h3 { margin: .8rem 0 0; font-size: 1rem; }
table { border-collapse: collapse; } th { text-align: left; color: var(--dim); }
th, td { padding: .3rem .8rem .3rem 0; overflow-wrap: normal;
  border-bottom: 1px solid var(--line); vertical-align: top; }
td.num { text-align: right; font-variant-numeric: tabular-nums; } .wide { overflow-x: auto; }
h1 { font-size: 1.5rem; } svg { width: 100%; min-width: 34rem; height: auto; }
svg text { fill: var(--dim); font: 11px system-ui; }
.axis { stroke: var(--line); } .curve { stroke: var(--curve); fill: none; stroke-width: 1.3; }
.limit { stroke: var(--limit); stroke-dasharray: 5 4; } .fault { fill: var(--fault); }
.alarm { fill: var(--alarm); }
""".strip()
_FIGURES = (
    "detector", "recall", "precision", "F1", "false alarms/h", "delay s (median)", "right item",
)  # fmt: skip


def _page(data: PlotData, judged: Evaluation, heading: str) -> bytes:
    parts = data.parts()
    sections = "".join(
        f"<h2>{format_to_second(round(part[0] * NS))} to {format_to_second(round(part[1] * NS))}"
        f"</h2>{''.join(_panel(data, name, part) for name in data.scores)}"
        for part in parts
    )
    body = (
        f"<h1>{escape_text(heading)}</h1>"
        '<p class="dim">The worst score of each second as a multiple of its threshold (dashed, 1). '
        "Bands are labelled faults, triangles are alarms. Times are UTC.</p>"
        f"<p>{escape_text(judged.promise)}</p>"
        f"{_table(_FIGURES, [_figures(row) for row in judged.rows], numbers=True)}"
        f"{sections or '<p>There are no scores in this record.</p>'}"
        f"<h2>Alarms</h2>{_alarms(data)}"
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape_text(heading)}</title><style>{_STYLE}</style></head><body>{body}</body>"
        "</html>\n"
    ).encode()


def _figures(row: EvaluationRow) -> list[str]:
    figures = (
        row.recall, row.precision, row.f1, row.false_alarms_per_hour, row.delay_median_s,
        row.isolated,
    )  # fmt: skip
    return [row.detector, *("-" if one is None else f"{one:.3g}" for one in figures)]


def _table(header: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: bool = False) -> str:
    cell = '<td class="num">' if numbers else "<td>"
    head = "".join(f'<th scope="col">{escape_text(name)}</th>' for name in header)
    lines = "".join(
        f"<tr><td>{escape_text(row[0])}</td>"
        f"{''.join(f'{cell}{escape_text(text)}</td>' for text in row[1:])}</tr>"
        for row in rows
    )
    return f'<div class="wide"><table><tr>{head}</tr>{lines}</table></div>'


def _alarms(data: PlotData) -> str:
    """Return the table of alarms, each with what contributed to it."""
    shown = sorted(data.alarms, key=lambda one: one.confirmed_ns)[:_MOST_ALARMS]
    if not shown:
        return "<p>There are none.</p>"
    rows = [
        [
            format_time(one.confirmed_ns)[:23], one.id, f"{one.score:.3g} > {one.threshold:.3g}",
            one.reason.text,
            ", ".join(f"{name} {share:.2g}" for name, share in one.reason.contributions[:5]),
        ]
        for one in shown
    ]  # fmt: skip
    more = len(data.alarms) - len(shown)
    note = f'<p class="dim">{more} later ones are left out.</p>' if more else ""
    return _table(("confirmed (UTC)", "alarm", "score", "reason", "contributions"), rows) + note


@dataclass(frozen=True, slots=True)
class _Axes:
    """Places in the panel of a part of the record."""

    part: tuple[float, float]

    def x(self, at_s: float) -> float:
        start, end = self.part
        share = min(max((at_s - start) / (end - start), 0.0), 1.0)
        return _LEFT + share * (_WIDE - _LEFT - 10)

    def y(self, score: float) -> float:
        low, high = math.log10(_LEAST), math.log10(_MOST)
        share = (math.log10(min(max(score, _LEAST), _MOST)) - low) / (high - low)
        return _HIGH - _BOTTOM - share * (_HIGH - _BOTTOM - _TOP)


def _panel(data: PlotData, detector: str, part: tuple[float, float]) -> str:
    axes = _Axes(part)
    shapes = [
        *_faults(data, axes), *_grid(axes), _curve(data.curve(detector, part), axes),
        *_marks(data, detector, axes),
    ]  # fmt: skip
    label = f"scores of {detector}"
    drawing = root("scores", (_WIDE, _HIGH), label, shapes)
    return f"<h3>{escape_text(detector)}</h3><div class='wide'>{drawing}</div>"


def _faults(data: PlotData, axes: _Axes) -> Iterator[SvgElement]:
    for label in data.labels:
        if label.to_ns / NS < axes.part[0] or label.from_ns / NS > axes.part[1]:
            continue
        left, right = axes.x(label.from_ns / NS), axes.x(label.to_ns / NS)
        text = f"fault {label.name or label.item or label.source}".strip()
        yield element(
            "rect", title(text), class_="fault", x=number(left), y=number(_TOP),
            width=number(max(right - left, 1.5)), height=number(_HIGH - _BOTTOM - _TOP),
        )  # fmt: skip


def _grid(axes: _Axes) -> Iterator[SvgElement]:
    for tick in _TICKS:
        y, kind = number(axes.y(tick)), "limit" if tick == 1.0 else "axis"
        yield element("line", class_=kind, x1=number(_LEFT), x2=number(_WIDE - 10), y1=y, y2=y)
        yield element(
            "text", f"{tick:g}", x=number(_LEFT - 6), y=number(axes.y(tick) + 4), text_anchor="end"
        )
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        at_s = axes.part[0] + share * (axes.part[1] - axes.part[0])
        text = format_time(round(at_s * NS))[11:19]
        anchor = {0.0: "start", 1.0: "end"}.get(share, "middle")
        yield element("text", text, x=number(axes.x(at_s)), y=number(_HIGH - 4), text_anchor=anchor)


def _curve(points: Sequence[tuple[float, float]], axes: _Axes) -> SvgElement:
    """Return a line through scores; it breaks where there was none for some seconds."""
    words, last_s = [], -math.inf
    for at_s, score in points:
        usual = max(3.0, 3 * (axes.part[1] - axes.part[0]) / _MOST_POINTS)
        words.append("L" if at_s - last_s <= usual else "M")
        words.append(f"{number(axes.x(at_s))} {number(axes.y(score))}")
        last_s = at_s
    return element("path", class_="curve", d=" ".join(words))


def _marks(data: PlotData, detector: str, axes: _Axes) -> Iterator[SvgElement]:
    for alarm in data.alarms:
        at_s = alarm.confirmed_ns / NS
        if alarm.detector == detector and axes.part[0] <= at_s <= axes.part[1]:
            x, y = axes.x(at_s), _TOP + 9
            points = f"{number(x - 5)},{number(y - 9)} {number(x + 5)},{number(y - 9)} "
            text = title(f"{alarm.id}: {alarm.reason.text}")
            yield element(
                "polygon", text, class_="alarm", points=f"{points}{number(x)},{number(y)}"
            )


def _image(data: PlotData, heading: str, kind: str) -> bytes:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        hint = "pip install 'amberbox[plot]', or write an html file"
        raise UsageError(f"{kind} needs matplotlib", hint) from None
    parts = data.parts()
    rows = [(part, name) for part in parts for name in data.scores][:_MOST_PARTS]
    rows = rows or [((0.0, 1.0), "no scores")]
    figure = Figure(figsize=(10, 1.2 + 2.4 * len(rows)), layout="constrained")
    panels = figure.subplots(len(rows), 1, squeeze=False)[:, 0]
    for panel, (part, name) in zip(panels, rows, strict=True):
        _image_panel(panel, data, name, part)
    figure.suptitle(heading, parse_math=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=110)
    return buffer.getvalue()


def _image_panel(panel: Any, data: PlotData, name: str, part: tuple[float, float]) -> None:
    points = data.curve(name, part) if name in data.scores else []
    start_s = part[0]
    panel.semilogy(
        [at_s - start_s for at_s, _ in points],
        [min(max(score, _LEAST), _MOST) for _, score in points], linewidth=1,
    )  # fmt: skip
    panel.axhline(1.0, color="tab:red", linestyle="--", linewidth=1)
    for label in data.labels:
        left, right = label.from_ns / NS, label.to_ns / NS
        if right >= part[0] and left <= part[1]:
            edges = max(left, part[0]) - start_s, min(right, part[1]) - start_s
            panel.axvspan(*edges, color="tab:orange", alpha=0.3, linewidth=0)
    at = [a.confirmed_ns / NS for a in data.alarms if a.detector == name]
    at = [one - start_s for one in at if part[0] <= one <= part[1]]
    top = panel.get_xaxis_transform()
    panel.plot(at, [0.94] * len(at), "v", color="tab:red", markersize=7, transform=top)
    panel.set_xlim(0, part[1] - start_s)
    panel.set_ylim(_LEAST, _MOST)
    panel.set_ylabel(name, parse_math=False)
    panel.grid(visible=True, alpha=0.3)
    panel.set_xlabel(f"s after {format_to_second(round(start_s * NS))} UTC")
