"""What the filters of an item leave, against what a mode wants to see of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from typing import Any

from amberbox.core.errors import Problem
from amberbox.core.mode import shortest_window_s
from amberbox.core.nodes import Node
from amberbox.monitoring.configuration.recorded import Item, Recorded
from amberbox.monitoring.plan import InputPlan, ModePlan

_NEVER_KEPT = "none"
_LONG_S = 10.0
"""Windows of this length or more are not compared with what was recorded."""
_PERIODS = 1.9
"""Two, less what a measured rate may be off."""
_SHORTEST_S = 0.1
"""Two instants at which monitors are evaluated."""


def filter_problems(plan: ModePlan, node: Node, recorded: Recorded) -> Iterator[Problem]:
    """Yield what the filters of ``black_box.yaml`` keep a mode from seeing.

    Freshness, and monitors of whole items, go by the recorder's counts before any filter, so
    filters matter to those who look at values over a time.
    """
    place = (node.mapping or {}).get("mappings", node)
    told: set[str] = set()
    for mapping in plan.mappings:
        for entry in (*mapping.inputs, *mapping.reads):
            name = entry.item.partition("__")[0]
            item = recorded.by_name.get(name)
            found = [] if item is None else [*_complaints(plan, entry, item)]
            found = found or [(what, False) for what in _too_short(plan, entry, name, recorded)]
            for what, is_error in found:
                if what not in told:
                    told.add(what)
                    yield place.problem("mappings", what, is_error=is_error)


def _complaints(plan: ModePlan, entry: InputPlan, item: Item) -> Iterator[tuple[str, bool]]:
    options = item.options
    if options.keep == _NEVER_KEPT:
        yield f"{item.name} is not recorded (keep: none)", True
        return
    by_counts = getattr(plan.module, "SEES_SILENCE", False) or entry.kind == "item"
    wanted_hz = wanted_rate_hz(plan.config)
    limit_hz = options.max_frequency
    if limit_hz is not None and wanted_hz is not None and wanted_hz > limit_hz:
        yield _too_slow(item, wanted_hz, limit_hz, by_counts), not by_counts
    if by_counts:
        return
    history = getattr(plan.module, "history_s", None)
    window_s = float(history(plan.config)) if history is not None else 0.0
    if limit_hz is not None and 0 < window_s < 1 / limit_hz:
        yield (
            f"looks back over {window_s:g} s, but {item.name} keeps one row in "
            f"{1 / limit_hz:g} s (max_frequency)",
            True,
        )
    if options.change is not None and 0 < window_s < options.change.heartbeat_s:
        yield (
            f"looks back over {window_s:g} s, but while nothing changes {item.name} keeps one row "
            f"in {options.change.heartbeat_s:g} s (change)",
            True,
        )


def _too_short(plan: ModePlan, entry: InputPlan, name: str, recorded: Recorded) -> Iterator[str]:
    """Yield that samples may pass between two looks, as far as the item's rate is known."""
    window_s = shortest_window_s(plan.module, plan.config)
    if entry.kind == "item" or not 0 < window_s < _LONG_S:
        return
    if window_s < _SHORTEST_S:
        yield (
            f"looks back over {window_s:g} s, but at most 20 times a second: samples between pass "
            f"unseen; make it {_SHORTEST_S:g} s or more"
        )
    rate_hz = recorded.rate_hz(name)
    if rate_hz is not None and window_s * rate_hz < _PERIODS:
        yield (
            f"looks back over {window_s:g} s, but {name} comes {rate_hz:.2g} times a second: what "
            f"changes between two samples may pass unseen; make it {2 / rate_hz:.2g} s or more"
        )


def _too_slow(item: Item, wanted_hz: float, limit_hz: float, by_counts: bool) -> str:
    what = f"expects {wanted_hz:g} Hz, {item.name} keeps at most {limit_hz:g} Hz (max_frequency)"
    return f"{what}: it counts what is received, not what is kept" if by_counts else what


def wanted_rate_hz(config: Any) -> float | None:
    """Return the rate that the arguments of a mode name, by their unit."""
    values = [
        getattr(config, field.name)
        for field in fields(config)
        if field.metadata.get("unit") == "Hz"
    ]
    return max((float(value) for value in values if value is not None), default=None)
