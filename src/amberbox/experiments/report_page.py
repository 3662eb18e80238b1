"""The report of a run as one HTML page: it needs no network, runs no script, and prints well."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, TypeAlias

from amberbox.core.clock import NS
from amberbox.core.svg import SvgElement, element, escape_text, number, root, title
from amberbox.core.timestamps import format_duration, format_to_second
from amberbox.experiments.report import PlotData, RunReport, StepRecord
from amberbox.experiments.run import RunEvent

WIDE, HIGH, LEFT, TOP, BOTTOM = 720.0, 220.0, 70.0, 20.0, 24.0
_STYLE = """
:root { color-scheme: light dark; --ink: #1c1f23; --paper: #fff; --dim: #5b6470; --line: #d5d9de;
  --good: #1a7f37; --bad: #c62828; --open: #9a6700; --curve: #0b62b8; }
@media screen and (prefers-color-scheme: dark) { :root { --ink: #e6e8ea; --paper: #16191d;
  --dim: #9aa4b0; --line: #3a414a; --good: #4fc36b; --bad: #ff7b72; --open: #e3b341;
  --curve: #6cb2ff; } }
@media print { :root { --ink: #000; --paper: #fff; --dim: #444; --line: #bbb; --good: #116329;
  --bad: #a40e26; --open: #7a4d00; --curve: #0a4f96; } }
body { font: 15px/1.45 system-ui, sans-serif; color: var(--ink); background: var(--paper);
  max-width: 60rem; margin: 0 auto; padding: 1.5rem 1rem; overflow-wrap: anywhere; }
h1 { margin: 0 0 .2rem; } h2 { margin: 2rem 0 .5rem; border-bottom: 1px solid var(--line); }
.verdict { font-size: 1.3rem; font-weight: 600; } .dim { color: var(--dim); }
.passed, .done { color: var(--good); } .failed, .error, .aborted { color: var(--bad); }
.undecided, .unknown, .interrupted, .waiting, .running { color: var(--open); }
table { border-collapse: collapse; width: 100%; } th { text-align: left; color: var(--dim); }
th, td { padding: .3rem .6rem .3rem 0; border-bottom: 1px solid var(--line);
  vertical-align: top; overflow-wrap: break-word; } td.long { overflow-wrap: anywhere; }
@media (max-width: 40rem) { body { font-size: 13px; padding: 1rem .6rem; }
  th, td { padding-right: .35rem; } }
.wide { overflow-x: auto; } .wide svg { max-width: 100%; height: auto; }
@page { size: A4; margin: 14mm; } @page turned { size: A4 landscape; margin: 12mm; }
@media print { body { max-width: none; padding: 0; font-size: 10pt; } .wide { overflow: visible; }
  h2 { break-after: avoid; margin-top: 1.2rem; } tr, svg, p { break-inside: avoid; }
  .wide svg { max-height: 24cm; } .turned { page: turned; } .turned svg { max-height: 15cm; }
  svg, .verdict { print-color-adjust: exact; } }
.plot .axis { stroke: var(--line); } .plot .curve { stroke: var(--curve); fill: none; }
.plot text { fill: var(--dim); font: 11px system-ui, sans-serif; }
""".strip()

_RIGHT = {"text_anchor": "end"}
TURNED_FROM = 900.0
"""Diagrams from this width on, in pixels, are printed on a page in landscape format."""
STATE, VERDICT = "state", "verdict"
LONG = 24
"""Texts of more characters may be broken within words in tables."""
Diagram: TypeAlias = Callable[[], SvgElement]
"""Draws the diagram with the states of its elements."""


def report_page(report: RunReport, diagram: Diagram | None = None) -> str:
    """Return the page. Every text of the report is escaped."""
    name = f"{report.title}: {report.run}"
    parts = [
        f"<h1>{escape_text(report.title)}</h1>",
        *_head(report),
        *(_diagram(diagram()) if diagram else ()),
        *_section("Criteria", _criteria(report)),
        *_section("Deviations and notes", _remarks(report)),
        *_section("Steps", _steps(report)),
        *_section("Plots", "".join(_plot(plot) for plot in report.plots)),
        *_section("Everything that happened", _events(report)),
        *_section("Details", _details(report)),
    ]
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape_text(name)}</title><style>{_STYLE}</style></head>\n"
        f"<body><main>\n{chr(10).join(parts)}\n</main></body></html>\n"
    )


def _wide(content: str) -> str:
    """Return what scrolls where it is wider than the page, also with the keyboard."""
    return f'<div class="wide" tabindex="0">{content}</div>'


def _section(name: str, content: str, kind: str = "") -> Iterator[str]:
    if content:
        start = f'<section class="{kind}">' if kind else "<section>"
        yield f"{start}<h2>{name}</h2>{content}</section>"


def _diagram(drawing: SvgElement) -> Iterator[str]:
    is_wide = float(dict(drawing.attributes)["width"]) >= TURNED_FROM
    yield from _section("Diagram", _wide(str(drawing)), "turned" if is_wide else "")


def _head(report: RunReport) -> Iterator[str]:
    verdict = report.verdict or "not over"
    yield f'<p class="verdict {verdict.partition(" ")[0]}">{verdict}</p>'
    if report.reasons:
        yield _list(report.reasons)
    begun = format_to_second(report.began_ns)
    lasted = "" if report.ended_ns is None else format_duration(report.ended_ns - report.began_ns)
    people = ", ".join(f"{who} ({role})" for role, who in report.people.items())
    about = [f"robot {report.robot}", begun, lasted, people]
    yield f'<p class="dim">{escape_text(", ".join(filter(None, about)))}</p>'


def _criteria(report: RunReport) -> str:
    rows = [
        (
            one.name,
            _value(one.value, one.unit) if one.value is not None else one.text,
            _limits(one.above, one.below, one.unit),
            one.during or "whole run",
            one.verdict,
        )
        for one in report.criteria
    ]
    return _table(("criterion", "measured", "expected", "during", VERDICT), rows)


def _value(value: float, unit: str) -> str:
    return f"{value:.4g} {unit}".rstrip()


def _limits(above: float | None, below: float | None, unit: str) -> str:
    pairs = (("at least", above), ("at most", below))
    return ", ".join(f"{word} {_value(limit, unit)}" for word, limit in pairs if limit is not None)


def _remarks(report: RunReport) -> str:
    names = {step.task: step.name for step in report.steps}
    rows = [
        (_at(report, event), event.kind, names.get(event.task, ""), event.text, event.who)
        for event in report.deviations
    ]
    return _table(("after", "kind", "step", "what was seen", "who"), rows)


def _steps(report: RunReport) -> str:
    rows = [
        (
            f"{number}",
            step.name,
            step.who or step.role,
            format_duration(step.from_ns - report.began_ns),
            "" if step.to_ns is None else format_duration(step.to_ns - step.from_ns),
            _came_of(step),
            step.state,
        )
        for number, step in enumerate(report.steps, 1)
    ]
    return _table(("no.", "step", "who", "after", "took", "what came of it", STATE), rows)


def _came_of(step: StepRecord) -> str:
    values = step.values
    if step.role == "robot":  # what has no value is no answer that was skipped
        values = {name: value for name, value in values.items() if value is not None}
    return "; ".join(filter(None, (step.text, _pairs(step.parameters), _pairs(values))))


def _pairs(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{k}: {_shown(v)}" for k, v in values.items() if v not in ("", {}))


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"({_pairs(value)})"
    known = {True: "yes", False: "no", None: "skipped"}
    return known[value] if value is None or isinstance(value, bool) else str(value)


def _events(report: RunReport) -> str:
    rows = [
        (
            f"{event.number}",
            _at(report, event),
            event.kind,
            event.task or event.element,
            event.text,
            event.who,
        )
        for event in report.events
    ]
    return _table(("no.", "after", "event", "element", "text", "who"), rows)


def _at(report: RunReport, event: RunEvent) -> str:
    return format_duration(event.at_ns - report.began_ns)


def _details(report: RunReport) -> str:
    rows = [
        ("run", report.run),
        ("experiment", report.experiment),
        ("diagram (SHA-256)", report.sha256),
        ("parameters", _pairs(report.parameters)),
        *((key.replace("_", " "), _shown(value)) for key, value in report.about.items()),
    ]
    return _table(("", ""), rows)


def _list(texts: Iterable[str]) -> str:
    return f"<ul>{''.join(f'<li>{escape_text(text)}</li>' for text in texts)}</ul>"


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table; a last column that is a state or a verdict has its colour."""
    if not rows:
        return ""
    top = "".join(f"<th>{head}</th>" for head in heads) if any(heads) else ""
    has_state = heads[-1] in (STATE, VERDICT)
    lines = []
    for row in rows:
        cells = [f"<td{_class(cell)}>{escape_text(cell)}</td>" for cell in row]
        if has_state:
            cells[-1] = f'<td class="{escape_text(row[-1])}">{escape_text(row[-1])}</td>'
        lines.append(f"<tr>{''.join(cells)}</tr>")
    table = f"<table><thead><tr>{top}</tr></thead><tbody>{''.join(lines)}</tbody></table>"
    return _wide(table)


def _class(cell: str) -> str:
    return ' class="long"' if len(cell) > LONG else ""


def _plot(plot: PlotData) -> str:
    if plot.text:
        text = f"{plot.name}: {plot.text}"
        return f'<p class="unknown">{escape_text(text)}</p>'
    return _wide(str(line_plot(plot)))


def line_plot(plot: PlotData) -> SvgElement:
    """Return a drawing of a variable over time; the line breaks where it is unknown."""
    known = [value for value in plot.values if value is not None]
    low, high = (min(known), max(known)) if known else (0.0, 1.0)
    margin = (high - low) * 0.05 or abs(high) * 0.05 or 1.0
    low, high = low - margin, high + margin
    last_s = max(plot.seconds[-1], 1 / NS)
    wide, tall = WIDE - LEFT, HIGH - TOP - BOTTOM

    def point(second: float, value: float) -> str:
        x = LEFT + wide * max(0.0, second) / last_s
        return f"{number(x)},{number(TOP + tall * (high - value) / (high - low))}"

    pairs = zip(plot.seconds, plot.values, strict=True)
    runs = groupby(pairs, lambda pair: pair[1] is None)
    lines = [
        " ".join(point(second, value) for second, value in run if value is not None)
        for is_unknown, run in runs
        if not is_unknown
    ]
    label = f"{plot.name} [{plot.unit}]" if plot.unit else plot.name
    return root("plot", (WIDE, HIGH), label, (
        title(label),
        *(element("line", class_="axis", x1=LEFT, x2=WIDE, y1=y, y2=y) for y in (TOP, TOP + tall)),
        element("text", f"{high:.4g}", x=LEFT - 6, y=TOP + 10, **_RIGHT),
        element("text", f"{low:.4g}", x=LEFT - 6, y=TOP + tall, **_RIGHT),
        element("text", "0 s", x=LEFT, y=HIGH - 8),
        element("text", f"{last_s:.4g} s", x=WIDE, y=HIGH - 8, **_RIGHT),
        element("text", label, x=LEFT, y=14),
        *(element("polyline", class_="curve", points=line) for line in lines),
    ))  # fmt: skip
