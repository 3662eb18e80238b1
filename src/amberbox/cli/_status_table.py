"""Layout of statuses as text: all components as a tree, or one with its outputs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from amberbox.cli._output import Paint, in_columns, plain
from amberbox.core.robot_status import RANK
from amberbox.core.types import Level, Status
from amberbox.monitoring.current_state import CurrentState, duration_text
from amberbox.monitoring.findings import AlarmChange
from amberbox.monitoring.plan import (
    ComponentDepth,
    DependencyPlan,
    MonitoringPlan,
    Naming,
    OutputPlan,
    branches,
)
from amberbox.monitoring.publishers.diagnostics import text_of

_DOTS = "..."


@dataclass(frozen=True, slots=True)
class StatusView:
    """Settings of the display of statuses: plan, colours, and width in columns (None: no limit).

    ``branches`` is the tree to use without a plan.
    """

    plan: MonitoringPlan | None = None
    paint: Paint = plain
    width: int | None = None
    branches: tuple[ComponentDepth, ...] = ()


def overview(board: CurrentState, view: StatusView) -> Iterator[str]:
    """Yield the lines of all components as a tree, and of the alarms."""
    components = board.components
    yield from _head(board, list(components.values()), view)
    rows = [
        (f"{'  ' * branch.depth}{branch.component}", components[branch.component])
        for branch in view.branches or _branches(board, view.plan)
        if branch.component in components
    ]
    yield from _table(rows, board.measured_ns, view)
    yield from _alarms(board.alarms, board.measured_ns, view)


def detail(board: CurrentState, component: str, view: StatusView) -> Iterator[str]:
    """Yield the lines of one component with its modes, outputs, dependencies and alarms."""
    yield from statuses_table(board, component, view)
    yield from _outputs(board.modes_of(component), Naming.of(view.plan), view)
    found = [c for c in view.plan.components if c.id == component] if view.plan else []
    for plan in found:
        needs = list(dict.fromkeys(_need(board, edge, view) for edge in plan.dependencies))
        if plan.part_of or needs or plan.recovery_actions:
            yield ""
        if plan.part_of:
            yield f"part of: {plan.part_of}"
        if needs:
            which = "" if plan.needs is None else f" {plan.needs}"
            yield f"needs{which}: {', '.join(needs)}"
        if plan.recovery_actions:
            yield f"recovery actions: {', '.join(plan.recovery_actions)}"
    yield from alarms_of(board, component, view)


def statuses_table(board: CurrentState, component: str, view: StatusView) -> Iterator[str]:
    """Yield the table of a component and its modes."""
    status = board.components.get(component)
    yield from _head(board, [status] if status else [], view)
    naming, modes = Naming.of(view.plan), board.modes_of(component)
    own = [(component, status)] if status else []
    rows = [*own, *((f"  {naming.monitor(mode)}", mode) for mode in modes)]
    yield from _table(rows, board.measured_ns, view)


def alarms_of(board: CurrentState, component: str, view: StatusView) -> Iterator[str]:
    """Yield the lines of one component's alarms."""
    found = [alarm for alarm in board.alarms if alarm.component == component]
    yield from _alarms(found, board.measured_ns, view)


def waiting(board: CurrentState, component: str) -> str:
    """Return one line on why a component is not usable."""
    status = board.components.get(component)
    if status is None:
        return f"{component}: {board.silence or 'no status of it yet'}"
    if board.silence:
        return f"{component}: {board.silence}"
    if status.state == "not_initialised":
        return f"{component}: not initialised: {status.reason}"
    if status.state == "not_monitored":
        needs = ", ".join(status.blocked_by)
        return f"{component}: it has no monitor, and what it needs does not work: {needs}"
    state = f"{status.level} ({status.state})" if status.state != status.level else status.level
    return f"{component}: {state}: {status.reason}" if status.reason else f"{component}: {state}"


def _head(board: CurrentState, statuses: Sequence[Status], view: StatusView) -> Iterator[str]:
    levels: Counter[Level] = Counter(status.level for status in statuses)
    level = board.status.level
    counted = ", ".join(
        view.paint(f"{levels[level]} {level}", level)
        for level in sorted(levels, key=RANK.__getitem__, reverse=True)
    )
    yield f"{view.paint(board.robot or 'robot', level)}: {counted or 'nothing is known'}"
    if board.silence:
        yield view.paint(board.silence, "unknown")


def _branches(board: CurrentState, plan: MonitoringPlan | None) -> list[ComponentDepth]:
    known = branches(plan) if plan is not None else []
    planned = {branch.component for branch in known}
    return known + [ComponentDepth(0, name) for name in board.components if name not in planned]


def _table(rows: Sequence[tuple[str, Status]], now_ns: int, view: StatusView) -> Iterator[str]:
    cells = [(name, s.level, _state(s), _lasted(s, now_ns), _why(s)) for name, s in rows]
    header = ("component", "level", "state", "for", "reason")
    lines = in_columns([header, *cells], "")
    yield lines[0]
    at = 2 + max(len(cell[0]) for cell in (header, *cells))
    for line, (_, status) in zip(lines[1:], rows, strict=True):
        end = at + len(status.level)
        fitted = _fit(line, view.width)
        yield fitted[:at] + view.paint(fitted[at:end], status.level) + fitted[end:]


def _state(status: Status) -> str:
    return "" if status.state == status.level else status.state.replace("_", " ")


def _lasted(status: Status, now_ns: int) -> str:
    return duration_text(now_ns - status.since_ns) if status.since_ns else ""


def _why(status: Status) -> str:
    blocked = f"blocked by {', '.join(status.blocked_by)}" if status.blocked_by else ""
    if status.state == "not_initialised":  # its reason is already the chain
        blocked = ""
    return "; ".join(filter(None, (blocked, status.reason)))


def _fit(line: str, width: int | None) -> str:
    return line if width is None or len(line) <= width else line[: width - len(_DOTS)] + _DOTS


def _outputs(modes: Sequence[Status], naming: Naming, view: StatusView) -> Iterator[str]:
    rows = [row for mode in modes for row in _rows_of(mode, naming)]
    if rows:
        yield ""
        yield from (
            _fit(line, view.width)
            for line in in_columns([("output", "value", "expected", "description"), *rows], "")
        )


def _rows_of(mode: Status, naming: Naming) -> Iterator[tuple[str, ...]]:
    known = naming.modes.get((mode.component, mode.mode))
    mappings = known.mappings if known else ()
    plans = {output.name: output for mapping in mappings for output in mapping.outputs}
    name = naming.monitor(mode)
    for output, value in mode.outputs.items():
        plan = plans.get(output)
        description = plan.description if plan else ""
        yield f"{name} / {output}", text_of(value), _expected(plan), description


def _expected(plan: OutputPlan | None) -> str:
    return "" if plan is None or plan.expectation.value is None else str(plan.expectation)


def _need(board: CurrentState, edge: DependencyPlan, view: StatusView) -> str:
    """Return a dependency's name and the level of the component or mode that gives its state."""
    judge = (edge.component, edge.mode) if edge.judged and not edge.problem else None
    status = next((s for s in board.statuses if (s.component, s.mode) == judge), None)
    if status is None or status.state == "not_monitored":
        return f"{edge.name} ({view.paint('not monitored', 'unknown')})"
    return f"{edge.name} ({view.paint(status.level, status.level)})"


def _alarms(alarms: Sequence[AlarmChange], now_ns: int, view: StatusView) -> Iterator[str]:
    if alarms:
        yield ""
        yield f"{len(alarms)} {'alarm' if len(alarms) == 1 else 'alarms'}:"
    for alarm in alarms:
        times = f", {alarm.count} times" if alarm.count > 1 else ""
        by = f" by {alarm.who}" if alarm.who else ""
        lasts = f"for {duration_text(now_ns - alarm.opened_ns)}"
        about = f"{alarm.severity}, {alarm.state}{by}, {lasts}{times}"
        cause = f"; because of {alarm.cause}" if alarm.cause else ""
        yield f"  {view.paint(alarm.id, alarm.level)} ({about}): {alarm.reason}{cause}"
