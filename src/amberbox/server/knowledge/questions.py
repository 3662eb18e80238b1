"""Questions about a robot's knowledge, as arguments of a worker process."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar

import msgspec

from amberbox.diagnosis.diagnose import COVERING, engine_names

if TYPE_CHECKING:
    Engine: TypeAlias = str
else:
    Engine = Literal[engine_names()]
"""The name of an engine; forms and questions refuse others."""
SymptomWord: TypeAlias = Literal["present", "absent", "unknown"]
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


class AskTrees(RobotQuestion, frozen=True, kw_only=True):
    """Ask for the fault trees of all functions, or of ``effect`` alone, with its cut sets."""

    effect: str = ""
    cut_sets: int = 100
    order: int | None = None


class AskRules(RobotQuestion, frozen=True, kw_only=True):
    """Ask for all answers to a goal, optionally with their proof or why there is none."""

    query: str
    from_: str = ""
    to: str = ""
    want: Literal["", "why", "why_not"] = ""
    steps: int = 0


def decode_question(arguments: Any, kind: type[Kind]) -> Kind:
    """Return the question in arguments of a worker; raises msgspec.ValidationError."""
    return msgspec.convert(arguments, kind)


def encode_question(question: RobotQuestion) -> dict[str, Any]:
    """Return a question as arguments for a worker."""
    found: dict[str, Any] = msgspec.to_builtins(question)
    return found


WORKER = "amberbox.server.knowledge.worker"
LIMIT_S = 20.0
MEMORY_BYTES = 1 << 30
