"""Symbols inside the shapes of BPMN: triggers of events, markers of gateways and activities, icons.

Triggers are drawn around the origin for an event of radius 18, gateway markers for one of 50 x 50,
icons and markers of activities in 16 x 16 from the origin.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence

from amberbox.core.svg import SvgElement, element, number
from amberbox.experiments.bpmn import Element, EventDefinition, Shape

_ERROR = "M-9 9L-4 -8L3.5 1.5L9 -9L4 8L-3.5 -1.5Z"
_CANCEL = "M-9 -6L-6 -9L0 -3L6 -9L9 -6L3 0L9 6L6 9L0 3L-6 9L-9 6L-3 0Z"
_PLUS = "M-3 -9H3V-3H9V3H3V9H-3V3H-9V-3H-3Z"
_GATEWAY_CROSS = "M-9 -9L9 9M9 -9L-9 9"
_OUTLINES: Mapping[str, str] = {
    "error": _ERROR,
    "cancel": _CANCEL,
    "signal": "M0 -9.5L9.5 7H-9.5Z",
    "escalation": "M0 -10L7 9L0 1.5L-7 9Z",
    "compensate": "M-1 -7V7L-10 0ZM9 -7V7L0 0Z",
    "link": "M-9 -3.5H2V-8.5L11 0L2 8.5V3.5H-9Z",
}


def trigger(
    events: Sequence[EventDefinition], *, throws: bool, parallel: bool
) -> Iterator[SvgElement]:
    """Yield the marker of an event: filled if it throws."""
    kind = events[0].kind if len(events) == 1 else ""
    ink = "ink" if throws else "blank"
    if kind == "message":
        yield from envelope(-9.5, -6.5, 19, 13, filled=throws)
    elif kind == "timer":
        yield element("circle", class_="blank", r=11.0, stroke_width=1.4)
        for hour in range(12):
            turn = math.radians(30 * hour)
            x, y = math.sin(turn), math.cos(turn)
            yield stroke(f"M{number(9 * x)} {number(9 * y)}L{number(11 * x)} {number(11 * y)}", 1)
        yield stroke("M2 -8.5L0 0H6.5", 1.5)
    elif kind == "conditional":
        yield element("rect", class_="blank", x=-7, y=-9.5, width=14, height=19, stroke_width=1.3)
        yield stroke("M-5 -6H5M-5 -2H5M-5 2H5M-5 6H5", 1.2)
    elif kind == "terminate":
        yield element("circle", class_="ink", r=10.5)
    elif kind:
        yield element("path", class_=ink, d=_OUTLINES[kind], stroke_width=1.3)
    elif parallel:
        yield element("path", class_=ink, d=_PLUS, stroke_width=1.3)
    else:
        yield pentagon(10.5, ink)


def gateway_marker(own: Element, shape: Shape) -> Iterator[SvgElement]:
    """Yield the marker of a gateway; that of an exclusive one only if the file shows it."""
    if own.type == "exclusiveGateway":
        if shape.marker:
            yield stroke("M-7.5 -9L7.5 9M7.5 -9L-7.5 9", 3.6)
    elif own.type == "parallelGateway":
        yield stroke("M0 -12V12M-12 0H12", 3.6)
    elif own.type == "inclusiveGateway":
        yield element("circle", class_="line", r=12.0, stroke_width=3)
    elif own.type == "complexGateway":
        yield stroke(f"M0 -12V12M-12 0H12{_GATEWAY_CROSS}", 3.2)
    elif own.instantiates and own.event_gateway == "parallel":
        yield element("circle", class_="line", r=14.0, stroke_width=1.2)
        yield element("path", class_="blank", d=_PLUS, stroke_width=1.2)
    else:
        yield element("circle", class_="line", r=14.5, stroke_width=1.2)
        if not own.instantiates:
            yield element("circle", class_="line", r=11.8, stroke_width=1.2)
        yield pentagon(7.5, "blank")


def activity_markers(own: Element, *, collapsed: bool) -> Iterator[list[SvgElement]]:
    """Yield the markers at the bottom of an activity from left to right."""
    if own.loop == "standard":
        yield [stroke("M6 13.6A6 6 0 1 1 10 13.7", 1.6), stroke("M2 13.8H6.4V9.4", 1.6)]
    elif own.loop:
        yield bars(upright=own.loop == "parallel")
    if own.type == "adHocSubProcess":
        yield [stroke("M1 9.5C4 4 7 5 8.5 7.5S13 11 15 6.5", 2.4)]
    if own.compensation:
        yield [element("path", class_="blank", d="M8 3V13L1 8ZM15 3V13L8 8Z", stroke_width=1.2)]
    if collapsed:
        yield plus_box()


def bars(*, upright: bool) -> list[SvgElement]:
    """Return three bars: many at once (upright), or one after the other."""
    return [stroke("M3 2V14M8 2V14M13 2V14" if upright else "M2 3H14M2 8H14M2 13H14", 2.4)]


def plus_box() -> list[SvgElement]:
    """Return the box with a plus of what can be opened."""
    frame = element("rect", class_="line", x=1, y=1, width=14, height=14, stroke_width=1.3)
    return [frame, stroke("M8 4V12M4 8H12", 1.5)]


def envelope(
    x: float, y: float, wide: float, high: float, *, filled: bool, grey: bool = False
) -> Iterator[SvgElement]:
    """Yield a message."""
    kind = "ink" if filled else "body band" if grey else "blank"
    yield element("rect", class_=kind, x=x, y=y, width=wide, height=high, stroke_width=1.3)
    corners = (x, y, x + wide / 2, y + high * 0.55, x + wide, y)
    flap = "M{} {}L{} {}L{} {}".format(*map(number, corners))
    yield element("path", class_="gap" if filled else "line", d=flap, stroke_width=1.3)


def pentagon(radius: float, kind: str) -> SvgElement:
    """Return the marker of several triggers."""
    corners = [math.radians(72 * corner - 90) for corner in range(5)]
    points = " ".join(
        f"{number(radius * math.cos(a))},{number(radius * math.sin(a))}" for a in corners
    )
    return element("polygon", class_=kind, points=points, stroke_width=1.3)


def stroke(path: str, thick: float) -> SvgElement:
    """Return a line."""
    return element("path", class_="line", d=path, stroke_width=thick)


def _user(own: Element) -> list[SvgElement]:
    body = "M1 15V12.5C1 10 3.5 8.8 5.5 8.4L8 10L10.5 8.4C12.5 8.8 15 10 15 12.5V15Z"
    return [element("path", class_="blank", d=body, stroke_width=1.2),
            element("circle", class_="blank", cx=8, cy=5, r=3.6, stroke_width=1.2),
            stroke("M4.5 4.2C6 4.6 6.6 3.6 8 3.4S10.6 4.4 11.5 4.2M4 15V12.6M12 15V12.6", 1.1),
    ]  # fmt: skip


def _manual(own: Element) -> list[SvgElement]:
    hand = ("M1 8.5C3 5.5 5 3.6 7 3.6C8.2 3.6 7.6 5 6.6 6H14C15.2 6 15.2 7.6 14 7.6H9.5H14.6"
            "C15.8 7.6 15.6 9.4 14.4 9.4H9.5H14C15 9.4 15 11 13.8 11H9.5H13C14 11 14 12.6 12.8 12.6"
            "H5.5C3.5 12.6 2 12 1 11")  # fmt: skip
    return [element("path", class_="blank", d=hand, stroke_width=1.1)]


def _service(own: Element) -> list[SvgElement]:
    teeth = []
    for corner in range(16):
        turn = math.radians(22.5 * corner + 11.25)
        radius = 7.4 if corner % 4 in (0, 1) else 5.4
        teeth.append(f"{number(8 + radius * math.cos(turn))},{number(8 + radius * math.sin(turn))}")
    return [element("polygon", class_="blank", points=" ".join(teeth), stroke_width=1.2),
            element("circle", class_="blank", cx=8, cy=8, r=2.5, stroke_width=1.2)]  # fmt: skip


def _send(own: Element) -> list[SvgElement]:
    return list(envelope(0.5, 3, 15, 10.5, filled=True))


def _receive(own: Element) -> list[SvgElement]:
    if not own.instantiates:
        return list(envelope(0.5, 3, 15, 10.5, filled=False))
    ring = element("circle", class_="blank", cx=8, cy=8, r=8.0, stroke_width=1.1)
    return [ring, *envelope(3, 5, 10, 7, filled=False)]


def _script(own: Element) -> list[SvgElement]:
    page = "M5 1H14C10.5 4.5 13.8 7.5 14 10C14 12.5 12.5 14 11 15H2C5.5 11.5 2.2 8.5 2 6"
    page += "C2 3.5 3.5 2 5 1Z"
    return [element("path", class_="blank", d=page, stroke_width=1.1),
            stroke("M4.2 4H10.5M3.8 6.6H10.4M5 9.2H12M5.2 11.8H12", 1)]  # fmt: skip


def _rule(own: Element) -> list[SvgElement]:
    return [element("rect", class_="blank", x=0.5, y=2, width=15, height=12, stroke_width=1.1),
            element("rect", class_="ink", x=0.5, y=2, width=15, height=3.2, stroke_width=1.1),
            stroke("M0.5 9.6H15.5M5 5V14", 1.1)]  # fmt: skip


ICONS: Mapping[str, Callable[[Element], list[SvgElement]]] = {
    "userTask": _user,
    "manualTask": _manual,
    "serviceTask": _service,
    "sendTask": _send,
    "receiveTask": _receive,
    "scriptTask": _script,
    "businessRuleTask": _rule,
}
