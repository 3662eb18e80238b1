"""What a mode makes of its outputs: level, state and reason."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from typing import Any

from amberbox.core.expression import Expression, ExpressionError
from amberbox.core.types import Level, Output, Status
from amberbox.monitoring.engine.findings import Condition
from amberbox.monitoring.engine.outputs import NOT_MEASURED, OutputState, worst
from amberbox.monitoring.plan import ModePlan

_NO_OUTPUTS = "it has no outputs"


class ModeState:
    """A mode as it stands. ``number`` is its place in ``plan.modes()``.

    ``told`` is the condition that the last transition led to; ``awaited`` is true from the
    beginning of an epoch until something is known. One that does not run stays unknown.
    """

    __slots__ = (
        *("plan", "number", "outputs", "level", "state", "reason", "since_ns", "told", "awaited"),
        *("status", "blank", "runs"),
    )

    def __init__(self, plan: ModePlan, number: int, outputs: Sequence[OutputState]) -> None:
        self.plan = plan
        self.number = number
        self.outputs = outputs
        self.blank: Mapping[str, Output] = {output.plan.name: None for output in outputs}
        self.level: Level = "unknown"
        self.state = "unknown"
        self.runs = bool(outputs) and not plan.problem
        self.reason = plan.problem or (NOT_MEASURED if outputs else _NO_OUTPUTS)
        self.since_ns = 0
        self.told: Condition | None = None
        self.awaited = True
        self.status: Status | None = None

    def begin(self, at_ns: int) -> None:
        """Begin an epoch: nothing is measured yet."""
        for output in self.outputs:
            output.begin()
        self.since_ns, self.awaited, self.status = at_ns, True, None
        if self.runs:
            self.level, self.state, self.reason = "unknown", "unknown", NOT_MEASURED

    def judge(self, values: Mapping[str, Output]) -> bool:
        """Look at the outputs again; tell whether level, state or reason differ from before.

        ``values`` are for the conditions of ``states:`` and needed only if there are any.
        """
        if not self.runs:
            return False
        before = self.level, self.state, self.reason
        if len(self.outputs) == 1:
            self.level = self.outputs[0].level
        else:
            self.level = worst(output.level for output in self.outputs)
        self.reason = "" if self.level == "ok" else self._reason()
        self.state = self._state(values)
        return before != (self.level, self.state, self.reason)

    def _state(self, values: Mapping[str, Output]) -> str:
        if self.level == "ok":
            return "nominal"
        if self.level in ("unknown", "stale"):
            return self.level
        for name, condition in self.plan.states.items():
            if _holds(condition, values):
                return name
        return next(o.plan.name for o in self.outputs if o.level == self.level)

    def _reason(self) -> str:
        shown = [output for output in self.outputs if output.level == self.level]
        shown += [o for o in self.outputs if o.shown == "bad" and o.level != self.level]
        return join_facts(output.text() for output in shown)

    @property
    def named(self) -> bool:
        """Tell whether its state now depends on conditions over its outputs."""
        return bool(self.plan.states) and self.level in ("warn", "error")

    def hints(self) -> Iterable[str]:
        """Return what can be done about outputs that are not as expected."""
        return (o.plan.hint for o in self.outputs if o.shown == "bad" and o.plan.hint)

    def known_values(self) -> Mapping[str, Output]:
        """Return the values that are known without the engine: bools and texts."""
        return {output.plan.name: output.value for output in self.outputs}

    def tell(self) -> tuple[Condition | None, Condition]:
        """Return the condition before and now if that is a transition; None as before if not.

        What was known before an epoch began is compared with what is known first in it.
        """
        before, after = self.told, Condition(self.level, self.state)
        if self.awaited and self.level == "unknown":
            return None, after
        self.awaited, self.told = False, after
        if before is None:
            before = after if self.level == "ok" else Condition("unknown", "unknown")
        return (None if before == after else before), after

    def snapshot(self, began_ns: int) -> list[Any]:
        """Return what has to be known to go on, beside the outputs."""
        told = None if self.told is None else list(self.told)
        same = self.told == (self.level, self.state)
        entry = [self.since_ns - began_ns, self.state if self.named else None, self.awaited]
        return entry if same else [*entry, told]

    def resume(self, entry: Sequence[Any], began_ns: int) -> None:
        """Go on from what ``snapshot`` returned; the outputs have been resumed before."""
        since, state, self.awaited, *told = entry
        self.since_ns, self.status = began_ns + since, None
        self.judge({})
        self.state = self.state if state is None else state
        self.told = Condition(self.level, self.state)
        if told:
            self.told = None if told[0] is None else Condition(*told[0])


def join_facts(texts: Iterable[tuple[str, str]]) -> str:
    """Join facts to one line; facts in a row that have the same cause share it."""
    parts = []
    for why, group in groupby(dict.fromkeys(texts), key=lambda text: text[1]):
        facts = "; ".join(fact for fact, _ in group)
        parts.append(f"{facts}: {why}" if why else facts)
    return "; ".join(parts)


def _holds(condition: Expression, values: Mapping[str, Output]) -> bool:
    """Tell whether a condition holds; one that its values do not fit does not."""
    try:
        return condition.evaluate(values) is True
    except ExpressionError:
        return False
