"""Questions as they go to a worker."""

from __future__ import annotations

from typing import Any, Literal, TypeAlias, TypeVar

import msgspec

Engine: TypeAlias = Literal["covering", "rules", "faulttree"]
SymptomWord: TypeAlias = Literal["present", "absent", "unknown"]
Kind = TypeVar("Kind")


class AboutRobot(msgspec.Struct, frozen=True, kw_only=True):
    """Which robot, when, by which of its folders; ``now_ns`` is by the server's clock."""

    robot: str
    now_ns: int
    at: str = ""
    config_hash: str = ""
    seconds: float = 15.0
    """So long an engine may think before it says what it has found by then."""
    exposure_h: float | None = None


class AskDiagnosis(AboutRobot, frozen=True, kw_only=True):
    """What is broken? With symptoms and answers that somebody gives.

    ``diagnosis`` is one of old, as of its last revision or of ``revision``.
    """

    symptoms: dict[str, SymptomWord] = {}
    answers: dict[str, str] = {}
    engine: Engine = "covering"
    diagnosis: str = ""
    revision: int = 0


class AskTrees(AboutRobot, frozen=True, kw_only=True):
    """What can make it lose a function? All of them, or one with its cut sets."""

    effect: str = ""
    cut_sets: int = 100
    order: int | None = None


class AskRules(AboutRobot, frozen=True, kw_only=True):
    """All answers of a goal, why, or why there is none."""

    query: str
    from_: str = ""
    to: str = ""
    want: Literal["", "why", "why_not"] = ""
    steps: int = 0


def read(arguments: Any, kind: type[Kind]) -> Kind:
    """Read a question."""
    return msgspec.convert(arguments, kind)


def written(question: AboutRobot) -> dict[str, Any]:
    """Return a question as arguments for a worker."""
    found: dict[str, Any] = msgspec.to_builtins(question)
    return found
