"""Experiments: what a BPMN file declares beside its diagram, for people, robot and verdict.

A BPMN modeller draws lanes, tasks, gateways and events. What they mean here is written as YAML:
in the extension elements of the file (``<amberbox:step>`` of a task, ``<amberbox:experiment>`` of
a process, namespace ``NAMESPACE``), or, where the file is not to be touched, beside it in a file
of the same name that ends in ``.yaml``: key ``experiment``, and ``steps`` by the id of the
element. The classes here are their keys.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from amberbox.core.config import Finding
from amberbox.core.expression import Expression
from amberbox.core.options import option
from amberbox.experiments.action import LONGEST_TIMEOUT_S, ParameterOptions

FOLDER = "experiments"
NAMESPACE = "urn:amberbox:experiment:1"

# Least role of the person who does the steps of a lane; `robot`: only service tasks
Role: TypeAlias = Literal["technician", "operator", "robot"]
FieldKind: TypeAlias = Literal["pass_fail", "confirm", "number", "choice", "text"]
# How an action of a service task may end other than well; each can raise an error of its own
ActionTrouble: TypeAlias = Literal[
    "failed", "refused", "aborted", "timeout", "outcome_unknown", "requirement"
]

# What a criterion measures; ``settling_time``, ``overshoot`` and ``rise_time`` need a target
Measure: TypeAlias = Literal[
    "max", "min", "mean", "std", "rms", "final", "range", "count", "fraction", "duration",
    "settling_time", "overshoot", "rise_time", "distance", "delay",
]  # fmt: skip
_TOWARDS_A_TARGET = ("settling_time", "overshoot", "rise_time")

# How a run ends: it went through; the robot or a step was not as it should be; a person ended it;
# the experiment could not be carried out
Outcome: TypeAlias = Literal["passed", "failed", "aborted", "error"]

# Codes of the errors that service tasks raise where nothing else is declared
DEFAULT_ERRORS: Mapping[ActionTrouble, str] = {
    "failed": "action_failed",
    "refused": "action_refused",
    "aborted": "action_aborted",
    "timeout": "action_timeout",
    "outcome_unknown": "outcome_unknown",
    "requirement": "requirement_not_met",
}


@dataclass(frozen=True)
class FieldOptions:
    """One field of a step's form; its name is the variable that its value is kept in.

    ``pass_fail`` gives true, false, or null where it was skipped; ``confirm`` true.
    """

    kind: FieldKind = option(doc="`pass_fail`, `confirm`, `number`, `choice` or `text`")
    label: str = option("", "question or name, for people; else the name of the variable")
    unit: str = option("", "unit of a number, for people")
    min: float | None = option(None, "smallest number")
    max: float | None = option(None, "largest number")
    choices: Sequence[str] = option((), "the values of a choice")
    required: bool = option(True, "whether the step can end without a value")

    def check(self) -> Iterator[Finding]:
        """Yield what is wrong with the values."""
        if (self.kind == "choice") != bool(self.choices):
            yield "choices", "are the values of `kind: choice`, and only of it"
        for key in ("unit", "min", "max"):
            if self.kind != "number" and getattr(self, key) not in ("", None):
                yield key, f"a {self.kind.replace('_', '/')} has none; it belongs to a number"
        if self.min is not None and self.max is not None and self.min > self.max:
            yield "min", f"{self.min:g} is above max, {self.max:g}"


@dataclass(frozen=True)
class PersonStepOptions:
    """A step of a person: a user task, or a manual task, which is only confirmed."""

    text: str = option("", "what to do; else the documentation of the element, or its name")
    picture: str = option("", "picture, a PNG, JPEG or SVG file beside the experiment")
    expected: str = option("", "what is to be seen if all is well")
    deviation: str = option("", "how to recognise that it is not")
    fields: Mapping[str, FieldOptions] = option({}, "fields of the form, by variable")


@dataclass(frozen=True)
class RobotStepOptions:
    """A step of the robot: a service task, which carries out an action or a unit test."""

    action: str = option("", "action of the robot (`actions/*.yaml`)")
    test: str = option("", "unit test of the robot (`tests/`), instead of an action")
    parameters: Mapping[str, Any] = option(
        {}, "values of its parameters; a text that begins with `=` is an expression"
    )
    requires: Expression | None = option(
        None, "what has to be true before it begins, over statuses and newest values of variables"
    )
    timeout: float | None = option(None, "longest run, if less than that of the action", unit="s")
    errors: Mapping[ActionTrouble, str] = option(
        {}, "error code that each kind of trouble raises, instead of the default"
    )
    results: Mapping[str, str] = option({}, "variables taken from the result, by its keys a.b.c")

    def check(self) -> Iterator[Finding]:
        """Yield what is wrong with the values."""
        if bool(self.action) == bool(self.test):
            yield "needs either an action or a test"
        if self.timeout is not None and not 0 < self.timeout <= LONGEST_TIMEOUT_S:
            yield "timeout", f"must be above 0 and at most {LONGEST_TIMEOUT_S:g} s"


@dataclass(frozen=True)
class CriterionOptions:
    """A pass criterion over recorded variables: a measure of one, and its limits."""

    measure: Measure = option(doc="how it is measured, such as `settling_time` or `max`")
    of: Expression = option(doc="variable or expression that is measured")
    along: Expression | None = option(None, "second coordinate of a path (`distance`)")
    name: str = option("", "what it is about, for people")
    during: str = option("", "id of the step over whose time it is measured; else the whole run")
    target: float | None = option(None, "value that it is to reach (`settling_time`, `overshoot`)")
    band: float | None = option(None, "distance from the target that counts as reached")
    above: float | None = option(None, "the measure has to be at least this")
    below: float | None = option(None, "the measure has to be at most this")
    unit: str = option("", "unit of the measure, for people")

    @property
    def history_ns(self) -> int:
        """Return how far its expressions look back."""
        return max(one.history_ns for one in (self.of, self.along) if one is not None)

    def check(self) -> Iterator[Finding]:
        """Yield what is wrong with the values."""
        if self.above is None and self.below is None:
            yield "has no limit: give above, below, or both"
        elif self.above is not None and self.below is not None and self.above > self.below:
            yield "above", f"{self.above:g} is more than below, {self.below:g}"
        if self.measure in _TOWARDS_A_TARGET and self.target is None:
            yield "measure", f"{self.measure} needs a target"
        if self.measure == "settling_time" and self.band is None:
            yield "measure", "settling_time needs a band: how near to the target is settled"
        if self.band is not None and not self.band > 0:
            yield "band", "must be above 0"


@dataclass(frozen=True)
class ExperimentOptions:
    """What an experiment is as a whole."""

    title: str = option("", "what it is called; else the name of the process")
    description: str = option("", "what it is for")
    safety: str = option("", "what to mind before it begins")
    duration: float | None = option(None, "how long it usually takes", unit="s")
    parameters: Mapping[str, ParameterOptions] = option({}, "what is chosen at the start")
    roles: Mapping[str, Role] = option(
        {}, "role of each lane, by its id; else by its name (technician, operator, robot)"
    )
    data: Sequence[str] = option((), "items that the robot has to record during the run")
    plots: Sequence[str] = option((), "variables that are drawn while it runs and in the report")
    criteria: Sequence[CriterionOptions] = option((), "what has to be true of the record to pass")
    ends: Mapping[str, Literal["passed", "failed", "aborted"]] = option(
        {}, "outcome of end events, by id; else `failed` after a failed step, or `passed`"
    )
    about: Sequence[str] = option((), "failure modes (`component#mode`) that its verdict speaks of")
