"""The numbers of an FMEA that the covering engine reasons with, and nothing else."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

from amberbox.core.config import did_you_mean
from amberbox.core.errors import UsageError
from amberbox.core.needs import Needs, cycles
from amberbox.core.types import UNKNOWN_FAULT
from amberbox.diagnosis.covering.tables import Tables

UNKNOWN = UNKNOWN_FAULT
"""The mode that stands for everything that is not in the FMEA."""


@dataclass(frozen=True, slots=True)
class Mode:
    """A failure mode ``component#mode`` with its prior probability.

    ``takes_down``: while it is there, its component does not serve those that need it.
    """

    id: str
    prior: float
    takes_down: bool = False
    criticality: float = 0.0

    @property
    def component(self) -> str:
        """Return the component that fails."""
        return self.id.partition("#")[0]


@dataclass(frozen=True, slots=True)
class Sign:
    """A symptom that can be seen: ``leak`` is how probable it shows without any cause.

    ``read_cost_s`` is what reading it on demand costs, None when it cannot be read on demand.
    """

    id: str
    leak: float = 0.0
    read_cost_s: float | None = 0.0


@dataclass(frozen=True, slots=True)
class Function:
    """Something that is lost when its needs are not met.

    A function named like a component is that component's service: it is also lost when a mode
    takes the component down. A name that is no function and has no mode is always up.
    """

    id: str
    needs: Needs


@dataclass(frozen=True, slots=True)
class Link:
    """A cause shows a symptom with probability ``detects``.

    ``cause`` is a failure mode, or a function: then its loss is the cause. Two links from one
    cause to one symptom are two independent ways to show it.
    """

    cause: str
    symptom: str
    detects: float


@dataclass(frozen=True, slots=True)
class Unknown:
    """What is not in the FMEA competes with the prior ``prior``.

    It shows any symptom with probability ``detects``. Nobody knows which symptoms it would show,
    so an absent symptom says nothing against it; ``denies`` above 0 makes each absent symptom
    count like an absent symptom of a cause with that probability. A large ``detects`` makes it
    a cheap excuse for two faults at once; the default leaves them most of their due.

    It may look like three or more known modes that begin within ``together_s`` of each other,
    like each with probability ``looks_like``; 0: it never does.
    """

    prior: float = 1e-3
    detects: float = 0.05
    denies: float = 0.0
    looks_like: float = 0.0
    together_s: float = 10.0


@dataclass(frozen=True)
class Model:
    """Failure modes, symptoms, functions and the links between them; checked, never changed.

    Raises UsageError for probabilities outside 0..1, names given twice or not at all, and needs
    that go in a circle. A prior of 1 counts as 1 - 1e-12.
    """

    modes: tuple[Mode, ...]
    signs: tuple[Sign, ...]
    links: tuple[Link, ...]
    functions: tuple[Function, ...] = ()
    unknown: Unknown | None = Unknown()

    def __post_init__(self) -> None:
        self._check_names()
        for circle in cycles({function.id: function.needs for function in self.functions}):
            raise UsageError(f"needs go in a circle: {' -> '.join((*circle, circle[0]))}")
        for mode in self.modes:
            _probability(mode.prior, f"prior of {mode.id}")
        for sign in self.signs:
            _probability(sign.leak, f"leak of {sign.id}")
        for link in self.links:
            _probability(link.detects, f"detects of {link.cause} for {link.symptom}")
        if self.unknown is not None:
            for name in ("prior", "detects", "denies", "looks_like"):
                _probability(getattr(self.unknown, name), f"{name} of {UNKNOWN}")

    @cached_property
    def tables(self) -> Tables:
        """Return the model as arrays and masks, made at first use."""
        return Tables.of(self)

    @cached_property
    def mode_ids(self) -> tuple[str, ...]:
        """Return the ids of the modes by their place; the unknown one is the last."""
        own = tuple(mode.id for mode in self.modes)
        return own if self.unknown is None else (*own, UNKNOWN)

    @cached_property
    def mode_places(self) -> dict[str, int]:
        """Return the place of each mode, the unknown one included."""
        return {name: place for place, name in enumerate(self.mode_ids)}

    @cached_property
    def sign_places(self) -> dict[str, int]:
        """Return the place of each symptom."""
        return {sign.id: place for place, sign in enumerate(self.signs)}

    @cached_property
    def function_places(self) -> dict[str, int]:
        """Return the place of each function."""
        return {function.id: place for place, function in enumerate(self.functions)}

    def mode_place(self, name: str) -> int:
        """Return the place of a mode; raise UsageError when there is none."""
        if name not in self.mode_places:
            near = did_you_mean(name, self.mode_ids)
            raise UsageError(f"there is no failure mode '{name}'{near}")
        return self.mode_places[name]

    def _check_names(self) -> None:
        _unique((mode.id for mode in self.modes), "failure mode", {UNKNOWN})
        _unique((sign.id for sign in self.signs), "symptom")
        _unique((function.id for function in self.functions), "function")
        causes = {mode.id for mode in self.modes} | set(self.function_places)
        for link in self.links:
            if link.cause not in causes:
                near = did_you_mean(link.cause, causes)
                raise UsageError(f"there is no cause '{link.cause}' of {link.symptom}{near}")
            if link.symptom not in self.sign_places:
                near = did_you_mean(link.symptom, self.sign_places)
                raise UsageError(f"there is no symptom '{link.symptom}' of {link.cause}{near}")


def _unique(names: Iterable[str], kind: str, taken: set[str] | None = None) -> None:
    seen = set(taken or ())
    for name in names:
        if name in seen:
            raise UsageError(f"the {kind} '{name}' is there twice")
        seen.add(name)


def _probability(value: float, what: str) -> None:
    if not 0.0 <= value <= 1.0:
        raise UsageError(f"the {what} is {value:g}, no probability", "give a number from 0 to 1")
