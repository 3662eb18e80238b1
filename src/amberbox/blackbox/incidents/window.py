"""The window of an incident in times of receipt, as they are known now."""

from __future__ import annotations

from amberbox.blackbox.incidents.incident import Incident, Span
from amberbox.blackbox.query.catalogue import look
from amberbox.blackbox.query.clockbook import ClockBook
from amberbox.blackbox.query.record import Record
from amberbox.blackbox.segments.build import can_build
from amberbox.core.clock import NS

_CLOSE_NS = 60 * NS


def windows_of(record: Record, incident: Incident) -> list[tuple[int, int]]:
    """Return the ranges ``[from, to)`` of an incident, in order.

    There are several where its clock was set in between and nobody knows by how much.
    """
    book = look(record.path, with_segments=can_build()).book
    found = sorted(_received(span, book) for span in incident.spans)
    if incident.state == "open":  # more is to come
        found[-1] = (found[-1][0], max(found[-1][1], incident.to_ns))
    joined = found[:1]
    for start, end in found[1:]:
        if start - joined[-1][1] <= _CLOSE_NS:
            joined[-1] = (joined[-1][0], max(joined[-1][1], end))
        else:
            joined.append((start, end))
    return joined


def _received(span: Span, book: ClockBook) -> tuple[int, int]:
    known = [book.received_ns(span.run, log_ns) for log_ns in (span.from_ns, span.to_ns)]
    if known[0] is None or known[1] is None:
        return span.received()
    return known[0], known[1] + 1
