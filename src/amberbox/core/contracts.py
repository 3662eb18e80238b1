"""The contracts of plugins: what a module in a folder of plugins offers and may use.

A plugin is one file; its name is the name in the YAML, its first line of text is shown to users.

=====================  =========================  ========================================
plugin                 folder                     contract
=====================  =========================  ========================================
source                 ``blackbox/sources``       ``core.source``
mode of a monitor      ``monitoring/modes``       ``core.mode``; ``ModeContract`` has defaults
probe                  ``monitoring/probes``      ``core.probe``
publisher of statuses  ``monitoring/publishers``  ``Publisher``
provider of evidence   ``diagnosis/evidence``     ``EvidenceProvider`` and what is named below
action of a robot      ``experiments/actions``    ``Action`` and what is named below it
detector               ``detection/detectors``    ``Detector`` and what is named above it
=====================  =========================  ========================================

The name of a provider of evidence is also that of the engine if it answers alone. It defines one
or more of

- ``needs`` and ``provide`` (``EvidenceProvider``): called for an instant, by the tracker when the
  evidence has changed, and by ``amberbox diagnose`` and the server where no tracker has asked it;
- ``follow`` (``FollowedEvidence``): the tracker calls it as a record grows, live and in replay;
- ``alone`` and the three texts of ``EvidenceEngine``: it can answer without the others.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeAlias, TypeVar

from numpy.typing import NDArray

from amberbox.core.mode import Result
from amberbox.core.types import Batch, Diagnosis, Status, Symptom

Span: TypeAlias = tuple[int, int]
"""From and to in nanoseconds; ``to`` itself is not part of the span."""


@dataclass(frozen=True, slots=True)
class Conflict:
    """A conflict: failure modes of which at least one is present, and why.

    ``finding`` is the id under which it is recorded; without one it is named after its faults.
    """

    faults: frozenset[str]
    source: str
    proof: str = ""
    finding: str = ""


@dataclass(frozen=True, slots=True)
class Finding:
    """A text that is evidence for no failure mode; it is shown and changes no probability."""

    text: str
    source: str


@dataclass(frozen=True, slots=True)
class AnsweredTest:
    """The result of a test of the FMEA, by the test's id."""

    test: str
    outcome: str
    source: str


EvidenceItem: TypeAlias = Symptom | Conflict | Finding | AnsweredTest


@dataclass(frozen=True, slots=True)
class EvidenceNeeds:
    """The input that a provider needs: how many seconds of the record before the instant.

    A provider that needs no ``symptoms`` is called first, and its finding on a symptom replaces the
    one that was read. The others are called one by one, each with all evidence known by then. The
    tracker calls one with a history every ten seconds as well, any other only when the symptoms
    have changed: its evidence must be a function of them. What one found that ``reads_symptoms``
    not, but only the record, stays as it is when a user adds symptoms.
    """

    history_s: float = 0.0
    symptoms: bool = True
    reads_symptoms: bool = True


@dataclass(frozen=True, slots=True)
class GivenEvidence:
    """Evidence given by a user: ``ID[=STATE]`` of symptoms, ``TEST=VALUE`` of tests."""

    symptoms: Sequence[str] = ()
    answers: Sequence[str] = ()


NOTHING_GIVEN = GivenEvidence()


class OutOfTimeError(Exception):
    """A budget was over before the search had ended."""


_TIME_BITS = 11


@dataclass(frozen=True, slots=True)
class Budget:
    """Limits of a search; each engine uses those that it has.

    ``nodes`` are the most nodes that are opened or held at a time, None for the default of the
    engine. ``steps`` are the most steps of a rule program, ``depth`` its deepest nesting of goals.
    A step is a goal that is run or tried again, a fact that is derived, or eight characters of a
    text or one element of a list that a built-in predicate makes. ``is_over`` is called now and
    then and returns True when the caller wants the search to end, since engines read no clock; the
    default, ``bool``, never does. ``is_past`` returns whether a share of the time, from 0 to 1, is
    over; engines that have a second way to an answer leave time for it.
    """

    nodes: int | None = None
    is_over: Callable[[], bool] = bool
    steps: int = 5_000_000
    depth: int = 400_000
    is_past: Callable[[float], bool] | None = None

    def until(self, share: float) -> Budget:
        """Return this budget with a share of its time; unchanged where shares are not known."""
        past = self.is_past
        return self if past is None else replace(self, is_over=lambda: past(share))

    def turn(self, to_come: int) -> Budget:
        """Return the budget of a search that shares the time with others, ``to_come`` after it.

        It has half of the time that is left, so that one that takes long leaves time for the
        others; the last one has all of it.
        """
        past = self.is_past
        if past is None or not to_come:
            return self
        gone = self.time_gone()
        left = (1.0 - gone) / 2
        return replace(
            self,
            is_over=lambda: past(gone + left),
            is_past=lambda share: past(gone + share * left),
        )

    def time_gone(self) -> float:
        """Return the share of the time that is over, to 0.1 %; 0 where shares are not known."""
        gone = 0.0
        for power in range(1, _TIME_BITS):
            if self.is_past is not None and self.is_past(gone + 0.5**power):
                gone += 0.5**power
        return gone

    def most_nodes(self, default: int) -> int:
        """Return the most nodes, given the default of the engine."""
        return default if self.nodes is None else self.nodes

    def check(self) -> None:
        """Raise OutOfTimeError if the caller wants the search to end."""
        if self.is_over():
            raise OutOfTimeError


class RecordedPast(Protocol):
    """A part of a robot's record; spans are nanoseconds, without their end."""

    @property
    def span(self) -> Span:
        """Return its first instant and its end, nanoseconds."""

    @property
    def recorded(self) -> tuple[Span, ...]:
        """Return the runs of the recorder, nanoseconds."""

    @property
    def watched(self) -> tuple[Span, ...]:
        """Return the runs of the watcher, nanoseconds."""

    def rows(self, topic: str, names: Sequence[str], span: Span) -> Iterable[Mapping[str, Any]]:
        """Yield the rows of an item, or that the box itself wrote on a channel, with the time
        ``received``.
        """


class EvidenceWindow(Protocol):
    """One robot at one instant, as a provider of evidence may use it."""

    @property
    def at_ns(self) -> int:
        """The instant."""

    @property
    def symptoms(self) -> Sequence[Symptom]:
        """Return the symptoms that count already, each with its evidence."""

    @property
    def folder(self) -> Path:
        """Return the robot folder; on a server a copy."""

    @property
    def given(self) -> GivenEvidence:
        """Return the evidence given by the user."""

    def past(self, needs: EvidenceNeeds) -> RecordedPast | None:
        """Return the record as far back as is needed; None without a record."""

    def lookups(self, needs: EvidenceNeeds) -> Sequence[Any]:
        """Return the predicates (``prolog.machine.Virtual``) that query that part of the record."""


ModelT = TypeVar("ModelT", contravariant=True)
CaseT = TypeVar("CaseT", contravariant=True)


class EvidenceProvider(Protocol[ModelT]):
    """A module that adds evidence about a robot; the model is its ``Knowledge``."""

    def needs(self, model: ModelT, folder: Path) -> EvidenceNeeds | None:
        """Return the input that it needs; None where this folder has nothing for it."""

    def provide(self, model: ModelT, window: EvidenceWindow) -> Iterable[EvidenceItem]:
        """Return its evidence; raises AmberboxError if it cannot run."""


class EvidenceFollower(Protocol):
    """Finds symptoms as a record grows; ``items`` are the names of the items whose rows it reads.

    ``troubles`` are what could not be evaluated the last time, and why. The symptoms of one that
    ``records`` are returned to the watcher, which writes them down; those of others are written
    already.
    """

    records: bool

    @property
    def items(self) -> frozenset[str]:
        """Return the names of the items whose rows are read."""

    @property
    def history_s(self) -> float:
        """Return how far back rows have to be fed again after ``resume``, in seconds."""

    @property
    def troubles(self) -> Mapping[str, str]:
        """Return what could not be evaluated, with the reason."""

    def begin(self, at_ns: int) -> list[Symptom]:
        """Begin an epoch, in which nothing is known yet; return the symptoms that this changes."""

    def feed(self, batch: Batch) -> None:
        """Add rows of any item; log times do not decrease."""

    def receive(self, found: Sequence[object]) -> None:
        """Add findings of the monitors, in order of time: statuses, symptoms and others."""

    def advance(self, after_ns: int, until_ns: int) -> list[Symptom]:
        """Return the symptoms that change in ``(after_ns, until_ns]``, in order of time."""

    def snapshot(self, until_ns: int) -> dict[str, Any] | None:
        """Return the state needed by ``resume``, as JSON; None for none."""

    def resume(self, snapshot: Mapping[str, Any], until_ns: int) -> None:
        """Restore the state that ``snapshot`` returned."""


class FollowedEvidence(Protocol[ModelT]):
    """A module that finds evidence as a record grows."""

    def follow(self, model: ModelT) -> EvidenceFollower:
        """Return the follower of one robot."""


class EvidenceEngine(Protocol[ModelT, CaseT]):
    """A module that can answer without the others; the case is a
    ``diagnosis.diagnose.DiagnosisContext``."""

    ALONE: str
    """Text above the answer of this provider alone."""
    NOTHING: str
    """Its answer if it finds nothing; empty to list the absent symptoms."""
    NO_ANSWERS: str
    """The refusal of answers to tests; empty where they count."""

    def alone(self, model: ModelT, window: EvidenceWindow, case: CaseT) -> Diagnosis | None:
        """Return its diagnosis; None if it finds no fault."""


_CONSTANTS = {
    **{name: name.upper() for name in ("results", "columns", "per_input", "sees_silence", "parts")},
    "always_timed": "TIMED",
    "probe": "PROBE",
}  # names in a module that are not those of the fields below


@dataclass(frozen=True, slots=True)
class ModeContract:
    """A mode of a monitor: what its module defines, and defaults for what it leaves out."""

    evaluate: Callable[..., Mapping[str, Any]]
    results: Sequence[Result] = ()
    columns: bool = False
    per_input: bool = False
    always_timed: bool = False
    sees_silence: bool = False
    parts: bool = False
    probe: str = ""
    timed: Callable[[Any], bool] | None = None
    in_silence: Callable[[Any], bool] | None = None
    history_s: Callable[[Any], float] | None = None
    shortest_s: Callable[[Any], float] | None = None
    results_of: Callable[[Any, int, int], Sequence[Result]] | None = None
    reads: Callable[[Any], Sequence[str]] | None = None
    probe_of: Callable[[Any, str], tuple[str, str]] | None = None
    explain: Callable[..., str] | None = None
    reason: Callable[..., str] | None = None
    explain_unknown: Callable[..., str] | None = None
    input_problems: Callable[[Any, Sequence[str]], Iterable[tuple[str, str]]] | None = None
    in_folder: Callable[[Any, Path], Any] | None = None

    @classmethod
    def of(cls, module: Any) -> ModeContract:
        """Return the contract of a module, or of any object with its names."""
        names = {field.name: _CONSTANTS.get(field.name, field.name) for field in fields(cls)}
        given = {field: getattr(module, name, None) for field, name in names.items()}
        return cls(**{field: value for field, value in given.items() if value is not None})

    def is_timed(self, config: Any) -> bool:
        """Return whether its results change as time passes, without a new sample."""
        return self.always_timed if self.timed is None else self.timed(config)

    def is_called_in_silence(self, config: Any) -> bool:
        """Return whether it is called also where its inputs are stale."""
        return self.sees_silence if self.in_silence is None else self.in_silence(config)

    def looks_back_s(self, config: Any) -> float:
        """Return how far back it looks, in seconds; 0 if it does not."""
        return 0.0 if self.history_s is None else float(self.history_s(config))

    def shortest_window_s(self, config: Any) -> float:
        """Return the shortest window that it looks back over, in seconds; 0 if it has none."""
        shortest = self.shortest_s or self.history_s
        return 0.0 if shortest is None else float(shortest(config))

    def reads_of(self, config: Any) -> Sequence[str]:
        """Return the addresses that its arguments name."""
        return () if self.reads is None else self.reads(config)


class Publisher(Protocol):
    """A message format for statuses, one file in ``monitoring/publishers``."""

    def messages(
        self, statuses: Sequence[Status], naming: Any, diagnosis: Diagnosis | None = None
    ) -> list[dict[str, Any]]:
        """Return the messages that carry the statuses of a robot at one time.

        ``naming`` (``monitoring.plan.Naming``) has the names of components and modes;
        ``diagnosis`` is the open one.
        """


class ActionContext(Protocol):
    """One run of an action, as its plugin sees it."""

    @property
    def parameters(self) -> Mapping[str, bool | int | float | str]:
        """Return the checked values of all declared parameters."""

    def stopped(self) -> bool:
        """Return whether the run must end: aborted, lease lost, or out of time."""

    def wait(self, seconds: float) -> bool:
        """Wait, or until the run must end; return whether it must."""

    def report(self, text: str) -> None:
        """Report progress in one line; more than a few lines a second are dropped."""


ConfigT = TypeVar("ConfigT", contravariant=True)


class Action(Protocol[ConfigT]):
    """A module that carries out one kind of action; ``Config`` is its class of options.

    ``SAMPLE`` is a declaration that passes ``amberbox check``. The module may also define

    - ``safe_stop(config, context)``: bring the robot to a safe state. It is called in the process
      of the run or in a new one, perhaps twice, perhaps while ``run`` still hangs. Without it the
      action cannot have the risk ``moves``. Its context is ``stopped`` when its time is up.
    - ``simulated(config, context)``: the twin of ``run`` that needs no robot.
    - ``problems(config, parameters)``: yield problems in the form of ``core.config.Finding``, seen
      with the names of the declared parameters.

    A declaration that leaves out an option ``safe_stop`` or ``simulated`` of ``Config`` has none.
    ``Config.in_folder(folder)`` returns the same options seen from the robot folder.
    """

    Config: type[Any]
    SAMPLE: str

    def run(self, config: ConfigT, context: ActionContext) -> Mapping[str, Any] | None:
        """Carry it out and return its result for JSON.

        Raises AmberboxError if it failed, NotStartedError if the robot has not been told anything.
        It polls ``context.stopped()`` at least every 0.1 s and returns soon after it is true.
        """


class Row(NamedTuple):
    """One message of an item, as detectors read it.

    ``at_ns`` is its time of arrival (``received``, ns), ``stamp_ns`` its own stamp, or ``at_ns`` if
    it has none. ``values`` are its numbers by variable, also NaN and infinite ones; what is null or
    absent is left out. ``texts`` are its texts, for events.
    """

    item: str
    at_ns: int
    stamp_ns: int
    values: Mapping[str, float]
    texts: Mapping[str, str] = {}


class MissionRows(Protocol):
    """The rows of a mission, in the order of their arrival; they can be read more than once."""

    @property
    def name(self) -> str:
        """Return its name, for reports."""

    @property
    def span(self) -> Span:
        """Return its start and end (times of arrival, ns)."""

    def __iter__(self) -> Iterator[Row]:
        """Yield its rows."""


class Score(NamedTuple):
    """How abnormal one series of a detector is at a time: from 0, of the order of 1 if nominal.

    A series is what has a threshold of its own: a source, a variable, a group, the whole robot. Its
    name is the same in every mission.
    """

    at_ns: int
    series: str
    value: float


@dataclass(frozen=True, slots=True)
class ScoreReason:
    """Why a score is high: the id of the alarm is ``detector.finding.item[.variable]``.

    ``contributions`` are the shares of variables or events, the greatest first; ``transitions`` the
    last ones before the alarm, the newest last; ``suspects`` the members of which at least one is
    faulty, where the detector knows that, and ``conflict`` the addresses of what is measured at
    them. ``text`` is one sentence with values and limits.
    """

    finding: str
    item: str
    variable: str = ""
    text: str = ""
    contributions: tuple[tuple[str, float], ...] = ()
    transitions: tuple[str, ...] = ()
    suspects: tuple[str, ...] = ()
    conflict: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class LearntState:
    """What a detector has learnt: values for JSON, and arrays of numbers (no objects)."""

    values: Mapping[str, Any] = field(default_factory=dict)
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)


class Detector(Protocol):
    """Learns from nominal missions and scores rows; the class ``Detector`` of its module.

    ``Detector(config)`` takes the module's ``Config``, a frozen dataclass of ``option`` fields with
    defaults. Thresholds, baselines, persistence, alarms and files are ``amberbox.detection``'s.

    It is given one row at a time, so that the scores of a stream are those of a batch. ``at_ns``
    never decreases within a mission; stamps may be late or step. Hostile input raises nothing: what
    cannot be used is counted in ``counts``, by a text such as ``values that are not finite``.

    Scores are also judged against the past of their mission, as they may be greater in one mission
    than in another; not those of a detector with ``own_baseline = False``.
    """

    version: int
    """Of what ``learnt`` returns; a file of another version is refused."""
    counts: dict[str, int]
    """What could not be used since the detector was made."""

    def fit(self, missions: Sequence[MissionRows]) -> None:
        """Learn from nominal missions, and forget what was learnt before.

        Raises AmberboxError if there is nothing to learn from.
        """

    def begin(self, at_ns: int) -> None:
        """Begin a mission: forget the rows before it."""

    def observe(self, row: Row) -> Sequence[Score]:
        """Return the scores that a row changes, at its time of arrival."""

    def tick(self, now_ns: int) -> Sequence[Score]:
        """Return the scores that change because time passes; called twice a second.

        All rows that arrived before ``now_ns`` have been observed.
        """

    def explain(self, series: str) -> ScoreReason:
        """Return the reason of the last score of a series."""

    def learnt(self) -> LearntState:
        """Return what was learnt, with the options that scores depend on."""

    def restore(self, state: LearntState) -> None:
        """Restore what was learnt; raise ValueError, KeyError or TypeError if it does not fit."""

    def snapshot(self) -> dict[str, Any]:
        """Return the state within a mission, as JSON, for ``resume``; it is exact."""

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Continue where ``snapshot`` was taken; raises as ``restore`` does."""
