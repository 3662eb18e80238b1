"""A rule program: what files, facts and lookups define together."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from amberbox.core.config import refuse
from amberbox.core.errors import Problem
from amberbox.diagnosis.rules.calls import called, called_terms
from amberbox.diagnosis.rules.clauses import Clause, Predicate
from amberbox.diagnosis.rules.compile import FIXED, compile_clause
from amberbox.diagnosis.rules.datalog.evaluate import Database
from amberbox.diagnosis.rules.directives import declarations
from amberbox.diagnosis.rules.faults import TOO_DEEP, Place, RuleFault
from amberbox.diagnosis.rules.library import library
from amberbox.diagnosis.rules.reader import Sentence, sentences
from amberbox.diagnosis.rules.sourcetext import SourceText, read_source
from amberbox.diagnosis.rules.terms import Key, Struct, Term, is_atomic, show_key, to_term
from amberbox.diagnosis.rules.unknown import unknown_predicate
from amberbox.diagnosis.rules.virtual import Virtual
from amberbox.diagnosis.rules.vocabulary import VOCABULARY
from amberbox.diagnosis.rules.warnings import suspicions

Fact = Sequence[object]
"""A name and its values: ``("drives", "motor_1", "wheel_2")``; strings are atoms."""


@dataclass(frozen=True)
class Program:
    """Predicates by name and number of arguments, and notes on what looks like a mistake.

    It does not change; what was worked out about it is kept with it.
    """

    predicates: Mapping[Key, Predicate]
    notes: tuple[Problem, ...] = ()
    sources: Mapping[str, SourceText] = field(default_factory=dict, repr=False)

    @cached_property
    def known(self) -> Mapping[Key, Predicate]:
        """Everything that a goal may call besides what is built in."""
        empty = {key: Predicate(key, origin="vocabulary") for key in VOCABULARY}
        return {**library(), **empty, **self.predicates}

    @cached_property
    def unknown(self) -> tuple[tuple[Clause, Key], ...]:
        """Calls of predicates that nobody defined, with the clause that has them."""
        return tuple(
            (clause, key)
            for predicate in self.predicates.values()
            for clause in predicate.clauses
            if clause.body is not None
            for key in called(clause.goals)
            if key not in self.known and key not in FIXED
        )

    @cached_property
    def heads(self) -> Mapping[Key, Place]:
        """Names of rules that no other rule calls: what the program concludes, with places.

        Those of files called ``questions*.pl`` are for people to ask.
        """
        rules = {
            key: clause.place
            for key, predicate in self.predicates.items()
            for clause in reversed(predicate.clauses)
            if clause.body is not None and not _is_of_questions(clause.place)
        }
        used = {
            called_key
            for key, predicate in self.predicates.items()
            for clause in predicate.clauses
            for called_key in called(clause.goals)
            if called_key != key
        }
        return {key: place for key, place in rules.items() if key not in used}

    @cached_property
    def database(self) -> Database:
        """The relations that were filled from the facts upwards."""
        return Database(self.known)

    def problems(self) -> list[Problem]:
        """Return what is wrong with the program as a whole."""
        return [self.unknown_problem(clause, key) for clause, key in self.unknown]

    def unknown_problem(self, clause: Clause, key: Key) -> Problem:
        """Say that a clause calls something that there is not."""
        fault = unknown_predicate(key, [*self.known, *FIXED])
        place = clause.calls.get(key, clause.place)
        source = self.sources.get(place.file)
        picture = source.picture(place) if source is not None else ""
        where = f"column {place.column}"
        return Problem(place.file, place.line, where, fault.what + picture, fault.hint)

    def with_facts(self, facts: Iterable[Fact], source: str = "facts") -> Program:
        """Return a program with more facts; ``source`` names them in proofs.

        Raises RuleFault for a value that has no term.
        """
        added: dict[Key, list[Clause]] = {}
        for number, (name, *values) in enumerate(facts, 1):
            clause = _fact(str(name), [to_term(value) for value in values], Place(source, number))
            added.setdefault(clause.key, []).append(clause)
        changed = {key: self._own(key).with_clauses(added[key]) for key in added}
        return Program({**self.predicates, **changed}, self.notes, self.sources)

    def with_virtual(self, *virtuals: Virtual) -> Program:
        """Return a program in which some predicates are lookups."""
        made = {v.key: Predicate(v.key, origin="vocabulary", virtual=v) for v in virtuals}
        return Program({**self.predicates, **made}, self.notes, self.sources)

    def _own(self, key: Key) -> Predicate:
        if key in FIXED:
            raise RuleFault(f"{show_key(key)} is built in and cannot have facts")
        return self.predicates.get(key) or Predicate(key, origin="facts")


def _is_of_questions(place: Place) -> bool:
    return Path(place.file).name.startswith("questions")


def _fact(name: str, values: list[Term], place: Place) -> Clause:
    if all(map(is_atomic, values)):
        return Clause((name, len(values)), tuple(values), None, 0, (), place)
    return compile_clause(Struct(name, tuple(values)), place, lambda _: None, {})


def read_rules(paths: Iterable[Path | str]) -> Program:
    """Read rule files as one program.

    Raises ConfigurationError with everything that is wrong in them.
    """
    problems: list[Problem] = []
    sources = [read_source(Path(path), problems) for path in paths]
    return _program([source for source in sources if source is not None], problems)


def read_text(text: str, file: str = "rules.pl") -> Program:
    """Read rules from a text; ``file`` is its name in messages."""
    return _program([SourceText(file, text)], [])


def _program(sources: Sequence[SourceText], problems: list[Problem]) -> Program:
    predicates: dict[Key, Predicate] = {}
    for source in sources:
        for sentence in sentences(source.text):
            if isinstance(sentence, RuleFault):
                problems.append(source.problem(sentence, 0))
            else:
                problems.extend(_add(sentence, source, predicates))
    refuse(problems)
    return Program(predicates, tuple(problems), {source.file: source for source in sources})


def _add(
    sentence: Sentence, source: SourceText, predicates: dict[Key, Predicate]
) -> Iterator[Problem]:
    """Add what a sentence says to the predicates; yield what is wrong with it."""
    try:
        term = sentence.term
        if isinstance(term, Struct) and term.name in (":-", "?-") and len(term.args) == 1:
            _declare(term.args[0], predicates)
            return
        clause = _compiled(sentence, source)
    except RuleFault as fault:
        yield source.problem(fault, sentence.at)
        return
    except RecursionError:
        yield source.problem(RuleFault(*TOO_DEEP), sentence.at)
        return
    predicates.setdefault(clause.key, Predicate(clause.key)).add(clause)
    for suspicion in suspicions(sentence) if sentence.names else ():
        yield source.problem(suspicion, sentence.at, is_error=False)


def _declare(directive: Term, predicates: dict[Key, Predicate]) -> None:
    for kind, key in declarations(directive):
        if key in FIXED:
            raise RuleFault(f"{show_key(key)} is built in")
        if kind in ("table", "dynamic"):
            predicate = predicates.setdefault(key, Predicate(key))
            predicate.tabled = predicate.tabled or kind == "table"


def _compiled(sentence: Sentence, source: SourceText) -> Clause:
    place = source.place(sentence.at)
    if not sentence.names and not sentence.places and isinstance(sentence.term, Struct):
        term = sentence.term
        return _checked(_fact(term.name, list(term.args), place))

    def where(goal: Term) -> Place:
        return source.place(sentence.places.get(id(goal), sentence.at))

    names = {variable: name for name, variable in sentence.names.items()}
    clause = _checked(compile_clause(sentence.term, place, where, names))
    if clause.goals:
        body = sentence.term.args[1] if isinstance(sentence.term, Struct) else "true"
        clause.calls = {key: where(goal) for key, goal in called_terms(body)}
    return clause


def _checked(clause: Clause) -> Clause:
    if clause.key in FIXED:
        hint = "give the predicate another name"
        raise RuleFault(f"{show_key(clause.key)} is built in and cannot be defined", hint)
    if clause.key == ("-->", 2):
        raise RuleFault("grammar rules (-->) are not supported", "write a rule with :-")
    return clause
