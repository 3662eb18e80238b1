"""The explanation of a diagnosis: plain texts, numbers and ids, ready to be shown anywhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

# What the robot can still do (VDA 5050); empty where unknown
Severity: TypeAlias = Literal["", "warning", "urgent", "critical", "fatal"]


@dataclass(frozen=True, slots=True)
class ExplainedFault:
    """A failure mode in words; ``cause`` is how it may occur, ``remedy`` how to repair it.

    ``gone_ns`` is since when none of its symptoms is present; for an ``intermittent`` fault this is
    no evidence. ``kind`` is its description without the instance.
    """

    id: str
    text: str
    severity: Severity = ""
    cause: str = ""
    remedy: str = ""
    gone_ns: int | None = None
    intermittent: bool = False
    kind: str = ""


@dataclass(frozen=True, slots=True)
class Possibility:
    """One hypothesis in words, with its failure modes (none: a false alarm).

    ``text`` names only the active ones, if any is active.
    """

    id: str
    text: str
    probability: float
    faults: tuple[ExplainedFault, ...]
    criticality: float = 0.0
    proof: str = ""


@dataclass(frozen=True, slots=True)
class ExplainedGroup:
    """Hypotheses that the evidence cannot distinguish: in one text, and each by itself."""

    text: str
    probability: float
    members: tuple[Possibility, ...]
    wider: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Confidence:
    """How sure: a word, the probability, and the least it can be if not all was looked at."""

    word: str
    probability: float
    at_least: float
    note: str = ""


@dataclass(frozen=True, slots=True)
class CausalPath:
    """The path by which a failure mode shows a symptom: directly, or by lost functions (``via``, in
    order).

    ``text`` names the lost functions in words, or the failure mode itself if it is direct.
    ``detects`` is the probability of the symptom when the cause at the end of the path is present.
    """

    fault: str
    via: tuple[str, ...]
    text: str
    detects: float


@dataclass(frozen=True, slots=True)
class SeenSymptom:
    """A symptom in words: its address, its onset, the data it was measured from, and its causal
    path.

    ``after_s`` counts from the first symptom; times are None where unknown. ``reason`` gives the
    measured value and its limit, ``gone_ns`` is when it disappeared. ``weight`` is its importance:
    the severity of its worst cause times the probability of that cause.
    """

    id: str
    text: str
    address: str
    onset_ns: int | None = None
    after_s: float | None = None
    measured_from: tuple[str, ...] = ()
    ways: tuple[CausalPath, ...] = ()
    reason: str = ""
    gone_ns: int | None = None
    weight: float = 0.0


@dataclass(frozen=True, slots=True)
class LostFunction:
    """Something that the robot cannot do any more."""

    id: str
    text: str
    severity: Severity


@dataclass(frozen=True, slots=True)
class Usability:
    """Whether the robot can be used: the worst of the leading possibilities."""

    severity: Severity
    text: str
    lost: tuple[LostFunction, ...] = ()
    careful: str = ""


@dataclass(frozen=True, slots=True)
class AnswerBranch:
    """The consequence of an answer to a test: its probability, and the hypothesis that would lead
    then.
    """

    answer: str
    probability: float
    leads: str
    then: float
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class ProposedAction:
    """Something to do: make safe, test (``test`` is its id), watch or repair.

    ``faults`` are the failure modes that it makes safe, ``severity`` that of the worst of them,
    ``why`` names them with their probability.
    """

    kind: Literal["make_safe", "test", "watch", "repair"]
    text: str
    test: str = ""
    faults: tuple[str, ...] = ()
    severity: Severity = ""
    why: str = ""


@dataclass(frozen=True, slots=True)
class TestInstance:
    """One of several tests that differ only in the instance, asked as one question."""

    where: str
    test: str
    outcomes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class NextStep:
    """What to do next: a test with its answers, empty if there is none, and remedies.

    ``make_safe`` comes before all else; ``text`` begins with it, ``then`` is the rest. ``order``
    has all actions in their order. ``instances`` are the tests that are asked as one, where which
    instance it is has to be found; ``test`` is the first of them, to which ``answers`` belong.
    ``about`` are the failure modes that may be there and that the test sees. ``run`` is the name of
    the experiment or unit test that the test is, ``kind`` the kind of the test.
    """

    text: str
    test: str = ""
    by: str = ""
    takes: str = ""
    risk: str = ""
    answers: tuple[AnswerBranch, ...] = ()
    splits: bool = False
    remedies: tuple[str, ...] = ()
    make_safe: tuple[ProposedAction, ...] = ()
    then: str = ""
    order: tuple[ProposedAction, ...] = ()
    instances: tuple[TestInstance, ...] = ()
    about: tuple[str, ...] = ()
    kind: str = ""
    run: str = ""


# How it is with a robot by its own diagnosis
MemberState: TypeAlias = Literal["open", "healed", "none", "unknown"]


@dataclass(frozen=True, slots=True)
class MemberDiagnosis:
    """The diagnosis of a robot of a team, if the team has lost a function of that robot.

    ``where`` is its folder, ``text`` the answer in one or two sentences. ``state`` is that of the
    diagnosis: none without a fault, unknown if it cannot be read; then ``text`` is the reason.
    """

    name: str
    where: str
    state: MemberState
    text: str
    at_ns: int | None = None
    diagnosis: str = ""
    probability: float | None = None
    use: str = ""
    next: str = ""


NodeKind: TypeAlias = Literal["cause", "lost", "symptom"]
NodeMark: TypeAlias = Literal["", "leading", "present", "contradicted", "unexplained"]


@dataclass(frozen=True, slots=True)
class GraphNode:
    """A box of the graph; ``small`` is its id, ``probability`` that of a failure mode."""

    id: str
    kind: NodeKind
    text: str
    small: str
    mark: NodeMark = ""
    probability: float | None = None


@dataclass(frozen=True, slots=True)
class GraphEdge:
    """An edge from a cause to its effect; ``missing`` if the effect is expected but absent.

    ``leading``: it belongs to a leading hypothesis.
    """

    start: str
    end: str
    missing: bool = False
    leading: bool = False


@dataclass(frozen=True, slots=True)
class CausalGraph:
    """Causes, lost functions and symptoms; the number of causes and symptoms that are left out."""

    nodes: tuple[GraphNode, ...]
    edges: tuple[GraphEdge, ...]
    more_causes: int = 0
    more_symptoms: int = 0


@dataclass(frozen=True, slots=True)
class Explanation:
    """A diagnosis for people: each question has an answer, ``details`` are for experts.

    ``headline`` is the answer in one or two sentences. ``broken`` is the leading group (None if
    nothing explains the symptoms), ``others`` are the next ones. ``unexplained`` symptoms are
    present but not explained by the leading group, ``against`` are expected but absent, ``unknown``
    are not in the FMEA, ``blocked`` do not count. ``members`` are the robots with faults, if it is
    the diagnosis of their team. ``cleared`` are failure modes beside active ones whose symptoms
    have all gone. Symptoms are in order: present ones first, then by importance.
    """

    diagnosis: str
    revision: int
    robot: str
    at_ns: int
    state: Literal["open", "healed"]
    headline: str
    broken: ExplainedGroup | None
    sure: Confidence
    because: tuple[SeenSymptom, ...]
    unexplained: tuple[SeenSymptom, ...]
    against: tuple[SeenSymptom, ...]
    unknown: tuple[str, ...]
    blocked: tuple[SeenSymptom, ...]
    others: tuple[ExplainedGroup, ...]
    use: Usability
    next: NextStep
    details: tuple[str, ...]
    graph: CausalGraph
    members: tuple[MemberDiagnosis, ...] = ()
    cleared: tuple[ExplainedFault, ...] = ()
