"""``triggers:`` and ``incidents:`` of ``robot.yaml``: when a window of the record is kept."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from amberbox.core.config import Node, did_you_mean
from amberbox.core.errors import AmberboxError, Problem, UsageError
from amberbox.core.expression import parse
from amberbox.core.expression_tree import of_monitors
from amberbox.core.ids import derive_id, is_id
from amberbox.core.options import option
from amberbox.core.standins import Finding
from amberbox.core.units import parse_duration_s

OWN = ("amberbox_", "probe_")
"""Items that no block of ``black_box.yaml`` names begin like this."""
_KINDS = ("when", "event", "silence")


class Named(Protocol):
    """What has a name."""

    @property
    def name(self) -> str:
        """Its name."""


@dataclass(frozen=True)
class TriggerOptions:
    """What makes an incident: an expression, an event of the box, or the silence of an item."""

    name: str = option(doc="name of the trigger, in events and incidents")
    when: str = option("", "expression: fires when it becomes true")
    event: str = option("", "kind of an event of the box, such as power_battery or source_*")
    silence: str = option("", "ITEM for 5s: fires when nothing is received of it for so long")
    before: float = option(60.0, "how much is kept from before", unit="s")
    after: float = option(20.0, "how much is kept from after", unit="s")
    hold_off: float = option(60.0, "after it has fired it does not fire again for", unit="s")
    reason: str = option("", "what is said of the incident; without, what fired")

    def check(self) -> Iterator[Finding]:
        """Say what is wrong with the values together."""
        if not is_id(self.name):
            yield "name", f"'{self.name}' is no id; '{derive_id(self.name)}' would be one"
        given = [kind for kind in _KINDS if getattr(self, kind)]
        if len(given) != 1:
            named = " and ".join(given) if given else "none"
            yield "name", f"one of when, event and silence is needed, {named} is given"
        for key in ("before", "after", "hold_off"):
            if getattr(self, key) < 0:
                yield key, "must not be below 0"
        if self.when and (problem := expression_problem(self.when, with_monitors=True)):
            yield "when", problem.what, problem.hint
        if self.silence and (what := _silence_problem(self.silence)):
            yield "silence", what

    def items(self) -> tuple[str, ...]:
        """Name the items it looks at, as far as it can be read."""
        if self.silence:
            return (silence_of(self.silence)[0],)
        names = (a.partition(".")[0] for a in self._addresses() if of_monitors(a) is None)
        return tuple(dict.fromkeys(names))

    def of_monitors(self) -> tuple[str, ...]:
        """Name the outputs of monitors and the statuses that it reads."""
        return tuple(a for a in self._addresses() if of_monitors(a) is not None)

    def _addresses(self) -> tuple[str, ...]:
        return parse(self.when).addresses() if self.when else ()


@dataclass(frozen=True)
class IncidentOptions:
    """How much incidents may hold, and how many triggers may make."""

    share: float = option(50.0, "most that incidents may hold of the quota", unit="%")
    per_hour: int = option(10, "most that triggers may make in an hour, one of them half")

    def check(self) -> Iterator[tuple[str, str]]:
        """Say which values cannot work."""
        if not 0 <= self.share <= 100:
            yield "share", "must be from 0 to 100"
        if self.per_hour < 1:
            yield "per_hour", "must be 1 or more"


def expression_problem(text: str, *, with_monitors: bool = False) -> AmberboxError | None:
    """Return why a text is no condition over recorded variables; None if it is one."""
    from amberbox.blackbox.keeper.conditions import condition_problem

    try:
        what = condition_problem(parse(text), with_monitors=with_monitors)
    except AmberboxError as error:
        return error
    return UsageError(what) if what else None


def silence_of(text: str) -> tuple[str, float]:
    """Read ``ITEM for 5s``; raises UsageError for anything else."""
    item, _, duration = text.partition(" for ")
    if not item.strip() or not duration.strip():
        raise UsageError(f"'{text}' is no silence", "write: ros_ropod_odom for 5s")
    seconds = parse_duration_s(duration)
    if seconds <= 0:
        raise UsageError(f"'{text}' lasts no time", "write: ros_ropod_odom for 5s")
    return item.strip(), seconds


def _silence_problem(text: str) -> str:
    try:
        silence_of(text)
    except UsageError as error:
        return f"{error.what}; {error.hint}"
    return ""


def repeated(named: Sequence[Named]) -> Iterator[str]:
    """Give the names that several have."""
    names = [entry.name for entry in named]
    yield from (name for name in dict.fromkeys(names) if names.count(name) > 1)


def trigger_problems(
    root: Node,
    triggers: Sequence[TriggerOptions],
    sources: Sequence[str],
    items: Sequence[str],
    monitors: Collection[str] | None = None,
) -> Iterator[Problem]:
    """Judge the items that triggers name by what the folder would record.

    ``root`` is ``robot.yaml``, ``sources`` are the names of the blocks, ``items`` the ones that
    are configured. A source that names none records what it hears. ``monitors`` are all outputs
    and statuses that there are, None if that is not known.
    """
    entries = ((root.mapping or {}).get("triggers") or root).items or ()
    for index, (node, trigger) in enumerate(zip(entries, triggers, strict=False)):
        for item in trigger.items():
            what = _unknown(item, sources, items)
            if what:
                yield node.problem(f"triggers[{index}]", what)
        for address in trigger.of_monitors():
            if monitors is not None and address not in monitors:
                what = f"there is no output or status '{address}'{did_you_mean(address, monitors)}"
                when = (node.mapping or {}).get("when", node)
                hint = "outputs are component/mode/output, statuses status(component/mode)"
                yield when.problem(f"triggers[{index}].when", what, hint)
    if any(trigger.when and trigger.items() for trigger in triggers):
        what = "names of variables are judged when they have been recorded"
        yield root.problem("triggers", what, is_error=False)


def _unknown(item: str, sources: Sequence[str], items: Sequence[str]) -> str:
    top = item.partition("__")[0]
    if top in items or item.startswith(OWN):
        return ""
    of = [source for source in sources if item.startswith(f"{source}_")]
    told = [source for source in of if any(i.startswith(f"{source}_") for i in items)]
    if of and len(told) < len(of):
        return ""
    near = did_you_mean(top, items)
    if of:
        return f"there will be no item '{top}'{near}"
    return f"no source of black_box.yaml gives an item '{top}'{near}"
