"""``missions:`` of ``robot.yaml``: what begins and ends a mission."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.folder.triggers import expression_problem
from amberbox.blackbox.keeper.options import MissionRule
from amberbox.core.config import build, load_yaml, refuse
from amberbox.core.errors import AmberboxError, Problem, UsageError
from amberbox.core.expression import parse
from amberbox.core.ids import derive_id, is_id
from amberbox.core.options import option
from amberbox.core.standins import Finding


@dataclass(frozen=True)
class MissionOptions:
    """What begins and ends the missions of one kind, read from what is recorded."""

    name: str = option(doc="kind of mission, such as transport")
    start: str = option(doc="expression: a mission begins when it becomes true")
    end: str = option(doc="expression: the mission ends when it becomes true")
    failed: str = option("", "expression, read at the end: whether it failed")
    outcome: str = option("", "expression, read at the end: what came of it, such as a status")
    parameters: Mapping[str, str] = option({}, "expressions, read at the start, by name")
    max: float | None = option(None, "it ends by itself after this, as timeout", unit="s")

    def check(self) -> Iterator[Finding]:
        """Say what is wrong with the values together."""
        if not is_id(self.name):
            yield "name", f"'{self.name}' is no id; '{derive_id(self.name)}' would be one"
        for key in ("start", "end", "failed"):
            text = getattr(self, key)
            if text and (problem := expression_problem(text)):
                yield key, problem.what, problem.hint
        for key, text in (("outcome", self.outcome), *self._parameters()):
            if text and (problem := _value_problem(text)):
                yield key, problem.what, problem.hint
        if self.max is not None and self.max <= 0:
            yield "max", "must be above 0"

    def _parameters(self) -> Iterator[tuple[str, str]]:
        yield from (("parameters", text) for text in self.parameters.values())

    def rule(self) -> MissionRule:
        """Return it as the keeper wants it."""
        return MissionRule(
            self.name, self.start, self.end, self.failed, self.outcome, dict(self.parameters),
            self.max,
        )  # fmt: skip


def _value_problem(text: str) -> AmberboxError | None:
    from amberbox.blackbox.keeper.conditions import address_problem

    try:
        what = address_problem(parse(text))
    except AmberboxError as error:
        return error
    return UsageError(what) if what else None


def read_rules(path: Path) -> tuple[MissionRule, ...]:
    """Read the rules of a robot folder or of a YAML file; other keys of the file do not matter.

    Raises UsageError when there is no such file, ConfigurationError for what is wrong in it.
    """
    file = path / "robot.yaml" if path.is_dir() else path
    if not file.is_file():
        raise UsageError(f"there are no rules at {file}", "name a robot.yaml with --rules")
    problems: list[Problem] = []
    root = load_yaml(file, problems)
    refuse(problems)
    listed = (root.mapping or {}).get("missions") if root is not None else None
    found: tuple[MissionRule, ...] = ()
    for node in (listed.items or ()) if listed is not None else ():
        built = build(MissionOptions, node, problems, "missions")
        found += () if built is None else (built.rule(),)
    refuse(problems)
    return found
