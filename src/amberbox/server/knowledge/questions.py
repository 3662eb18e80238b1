"""Questions about a robot's knowledge, as arguments of a worker process."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar

import msgspec

from amberbox.core.equations.structure import Causality
from amberbox.core.types import RunKind
from amberbox.diagnosis.consistency.question import Minimal
from amberbox.diagnosis.diagnose import COVERING, engine_names

if TYPE_CHECKING:
    Engine: TypeAlias = str
else:
    Engine = Literal[engine_names()]
"""The name of an engine; forms and questions refuse others."""
SymptomWord: TypeAlias = Literal["present", "absent", "unknown"]
StructureView: TypeAlias = Literal["faults", "matrix", "mso", "mtes", "sensor_sets", "residuals"]
Kind = TypeVar("Kind")


class RobotQuestion(msgspec.Struct, frozen=True, kw_only=True):
    """The robot, the time, and the folder of a question; ``now_ns`` is the server's clock."""

    robot: str
    now_ns: int
    at: str = ""
    config_hash: str = ""
    seconds: float = 15.0
    """Time after which an engine stops and returns the results found so far."""
    exposure_h: float | None = None


class AskDiagnosis(RobotQuestion, frozen=True, kw_only=True):
    """Ask for a diagnosis, with symptoms and answers that a person gives.

    ``diagnosis`` is the id of an earlier one, at its last revision or at ``revision``.
    """

    symptoms: dict[str, SymptomWord] = {}
    answers: dict[str, str] = {}
    engine: Engine = COVERING
    diagnosis: str = ""
    revision: int = 0


class AskRunAnswers(RobotQuestion, frozen=True, kw_only=True):
    """Ask what a finished run answers; of ``diagnosis``, or else of the newest one."""

    kind: RunKind
    name: str
    verdict: str
    diagnosis: str = ""


class AskTrees(RobotQuestion, frozen=True, kw_only=True):
    """Ask for the fault trees of all functions, or of ``effect`` alone, with its cut sets."""

    effect: str = ""
    cut_sets: int = 100
    most_probable: int = 0
    order: int | None = None


class AskRules(RobotQuestion, frozen=True, kw_only=True):
    """Ask for all answers to a goal, optionally with their proof or why there is none."""

    query: str
    from_: str = ""
    to: str = ""
    want: Literal["", "why", "why_not"] = ""
    steps: int = 0


class AskModel(RobotQuestion, frozen=True, kw_only=True):
    """Ask about a model of the robot's folder; ``model`` may be empty where there is only one."""

    model: str = ""
    most: int = 1000
    """Sets, or diagnoses and conflicts, at most."""


class AskStructure(AskModel, frozen=True, kw_only=True):
    """Ask what a model of equations can show, by ``causality`` of derivatives."""

    show: StructureView = "faults"
    causality: Causality = Causality.MIXED
    measurable: list[str] = []
    fallible: bool = False


class AskResidual(AskModel, frozen=True, kw_only=True):
    """Ask for the size of a residual over time, in at most ``points`` values."""

    residual: str
    from_ns: int
    to_ns: int
    points: int = 500


class AskConsistency(AskModel, frozen=True, kw_only=True):
    """Ask which modes of components agree with the steps of a model, and ``observe``."""

    observe: list[str] = []
    minimal: Minimal = "subset"


def decode_question(arguments: Any, kind: type[Kind]) -> Kind:
    """Return the question in arguments of a worker; raises msgspec.ValidationError."""
    return msgspec.convert(arguments, kind)


def encode_question(question: RobotQuestion) -> dict[str, Any]:
    """Return a question as arguments for a worker."""
    found: dict[str, Any] = msgspec.to_builtins(question)
    return found


WORKER = "amberbox.server.knowledge.worker"
MODELS_WORKER = "amberbox.server.knowledge.worker_models"
LIMIT_S = 20.0
MEMORY_BYTES = 1 << 30
