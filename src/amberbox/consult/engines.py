"""Who answers: everything together, or the rules or the fault trees alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from amberbox.consult.case import Case, answered, heading_of
from amberbox.consult.facts import known_facts, lookups
from amberbox.consult.rulefiles import rule_files
from amberbox.consult.span import DAY_NS, Window
from amberbox.core.config import refuse
from amberbox.core.errors import UsageError
from amberbox.core.types import Diagnosis
from amberbox.diagnosis import faulttree_engine
from amberbox.diagnosis.findings import rules as rules_engine
from amberbox.diagnosis.findings.facts import Facts, seen_facts
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.diagnosis.make_safe import with_make_safe
from amberbox.diagnosis.rules import Program, read_rules


@dataclass(frozen=True, slots=True)
class Ground:
    """What rules can be asked about: the folder's rules, and the record before an instant.

    ``past`` opens a part of the record, by its first and last instant; None where there is none.
    """

    knowledge: Knowledge
    folder: Path
    past: Callable[[int, int], Window] | None
    lookback_ns: int

    def files(self) -> list[Path]:
        """Return the rule files."""
        return rule_files(self.folder)

    def program(self) -> Program:
        """Read the rules; raises ConfigurationError with all that is wrong in them."""
        program = read_rules(self.files())
        refuse(program.problems())
        return program

    def facts(self, case: Case) -> Facts:
        """Return what is known of the robot, what was seen, and lookups in the record."""
        known = known_facts(self.knowledge.robot, self.knowledge.fmea, self.knowledge.exposure_h)
        seen = tuple(seen_facts(case.situation.symptoms, self.knowledge.fmea))
        if self.past is None:
            return Facts(tuple(known), seen)
        window = self.past(case.at_ns - max(self.lookback_ns, DAY_NS), case.at_ns + 1)
        return Facts(tuple(known), seen, tuple(lookups(window)))


def with_findings(ground: Ground, case: Case) -> Case:
    """Return the case with what the folder's rules find in it, if there are any."""
    if not ground.files():
        return case
    fmea = ground.knowledge.fmea
    found = rules_engine.rule_findings(ground.program(), fmea, ground.facts(case), case.at_ns)
    situation = rules_engine.with_rule_findings(case.situation, found)
    if found.symptoms or found.conflicts:
        standing = None if case.is_over else case.standing
        return replace(case, situation=situation, standing=standing, has_more=True)
    return replace(case, situation=situation, standing=_with_texts(case.standing, found.findings))


def _with_texts(standing: Diagnosis | None, texts: tuple[str, ...]) -> Diagnosis | None:
    """Return a diagnosis with findings that speak for no failure mode, and so change nothing."""
    if standing is None or not texts:
        return standing
    return replace(standing, findings=tuple(dict.fromkeys((*standing.findings, *texts))))


def diagnosis_by(engine: str, ground: Ground, case: Case) -> Diagnosis | None:
    """Return what an engine makes of a case; None if it finds nothing wrong.

    Raises UsageError where there are no rules to ask.
    """
    made = _made_by(engine, ground, case)
    return None if made is None else with_make_safe(ground.knowledge.fmea, made)


def _made_by(engine: str, ground: Ground, case: Case) -> Diagnosis | None:
    if engine == "rules":
        return _by_rules(ground, case)
    if engine == "faulttree":
        return _by_fault_trees(ground.knowledge, case)
    return answered(ground.knowledge, case)


def _by_rules(ground: Ground, case: Case) -> Diagnosis | None:
    if not ground.files():
        raise UsageError(f"there are no rules/*.pl in {ground.folder}", "see docs/rules.md")
    heading = heading_of(ground.knowledge, case)
    facts = ground.facts(case)
    made = rules_engine.conclude(ground.knowledge, ground.program(), facts, heading)
    return _if_any(made, made.findings)


def _by_fault_trees(knowledge: Knowledge, case: Case) -> Diagnosis | None:
    if not case.situation.present():
        return None
    made = faulttree_engine.conclude(knowledge, case.situation, heading_of(knowledge, case))
    return _if_any(made, made.symptoms)


def _if_any(made: Diagnosis, else_because: Sequence[str]) -> Diagnosis | None:
    return made if made.hypotheses or else_because else None
