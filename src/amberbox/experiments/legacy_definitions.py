"""Experiments of the predecessor, state machines in TOML, as BPMN with a diagram.

A state becomes a service task with the action of its command; ``done`` goes on to the next one, any
error (``failed``) leaves by an event on its border, other transitions by a gateway behind it.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from amberbox.core.errors import Problem, did_you_mean
from amberbox.core.names import derive_id
from amberbox.core.safe_text import one_line
from amberbox.experiments.action import LONGEST_TIMEOUT_S
from amberbox.experiments.bpmn import BpmnModel, Element, EventDefinition, ExtensionText, Flow
from amberbox.experiments.bpmn_writer import bpmn_text
from amberbox.experiments.diagram_layout import laid_out

MOST_BYTES = 1_000_000
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}")
_LANE = "lane_robot"
_ENDS = {"failed": "failed", "aborted": "aborted", "preempted": "aborted"}
_ERRORS = ("failed", "aborted", "preempted")  # transitions that leave a state by an error


@dataclass(frozen=True)
class ImportedDefinition:
    """A state machine as an experiment: its name and the BPMN file."""

    name: str
    bpmn: str


def is_definition(path: Path) -> bool:
    """Return whether a file is named as definitions are: ``NAME.toml`` or ``NAME.toml.PLACE``."""
    return ".toml" in path.suffixes and not path.name.startswith(".")


def import_definition(
    path: Path, name: str = ""
) -> tuple[ImportedDefinition | None, list[Problem]]:
    """Read a state machine; return it as an experiment, or None if a problem is an error."""
    reading = _Definition(path, name or definition_name(path))
    model = reading.read()
    is_wrong = any(problem.is_error for problem in reading.problems)
    if model is None or is_wrong:
        return None, reading.problems
    model = replace(model, diagrams=(laid_out(model),))
    return ImportedDefinition(reading.name, bpmn_text(model)), reading.problems


def definition_name(path: Path) -> str:
    """Return the name of an experiment: ``dock.toml.hbrs`` is ``dock_hbrs``."""
    return derive_id(path.name.replace(".toml", "", 1).replace(".", "_"))


class _Definition:
    """One file while it is read."""

    def __init__(self, path: Path, name: str) -> None:
        self.path = path
        self.name = name
        self.problems: list[Problem] = []
        self.lines: list[str] = []
        self.states: list[str] = []
        self.outcomes: list[str] = []
        self.described: Mapping[str, Any] = {}
        self.shared: Mapping[str, Any] = {}

    def _problem(
        self, line: int, where: str, what: str, hint: str = "", *, note: bool = False
    ) -> None:
        self.problems.append(Problem(str(self.path), line, where, what, hint, not note))

    def read(self) -> BpmnModel | None:
        table = self._table()
        if table is None:
            return None
        self.states = self._names(table, "states")
        self.outcomes = self._names(table, "outcomes")
        described = table.get("state_descriptions")
        if not isinstance(described, dict) or not self.states:
            hint = "a definition has states, outcomes and state_descriptions"
            self._problem(1, "file", "is no experiment of the predecessor: it has no states", hint)
            return None
        self.described = described
        shared = table.get("arguments", {})
        self.shared = shared if isinstance(shared, dict) else {}
        listed = self.states
        self.states = [state for state in listed if self._is_described(state)]
        for state in [*self.states, *(own for own in described if own not in listed)]:
            self._check_state(state)
        if any(problem.is_error for problem in self.problems):
            return None
        return self._model(self._first(), str(table.get("sm_id") or self.name))

    def _table(self) -> dict[str, Any] | None:
        try:
            data = self.path.read_bytes()
            if len(data) > MOST_BYTES:
                self._problem(1, "file", f"has more than {MOST_BYTES / 1e6:g} MB")
                return None
            text = data.decode("utf-8-sig")
            self.lines = text.splitlines()
            return tomllib.loads(text)
        except OSError as error:
            self._problem(1, "file", f"cannot be read: {error.strerror or error}")
        except tomllib.TOMLDecodeError as error:
            place = re.search(r"at line (\d+)", str(error))
            line = int(place[1]) if place else max(len(self.lines), 1)
            self._problem(line, "file", f"is no valid TOML: {one_line(str(error))}")
        except (UnicodeDecodeError, RecursionError):
            self._problem(1, "file", "is no UTF-8 text that can be read", "save it as UTF-8")
        return None

    def _names(self, table: Mapping[str, Any], key: str) -> list[str]:
        given = table.get(key)
        if not isinstance(given, list) or not all(
            isinstance(name, str) and _NAME.fullmatch(name) for name in given
        ):
            hint = "letters, digits and _ only"
            self._problem(self._line(key), key, "has to be a list of names", hint)
            return []
        found: dict[str, str] = {}  # an id of the diagram is the name in small letters
        for name in given:
            if found.setdefault(name.lower(), name) != name:
                self._problem(self._line(key), key, f"'{name}' is listed twice")
        return list(found.values())

    def _line(self, key: str, section: str = "") -> int:
        """Return the line of a key below the heading of a section; else that of the heading."""
        heading = rf"\s*\[+{re.escape(section)}\]+"
        start = next(
            (n for n, line in enumerate(self.lines) if section and re.match(heading, line)), 0
        )
        for number, line in enumerate(self.lines[start + bool(section) :], start + bool(section)):
            if re.match(rf"\s*{re.escape(key)}\s*=", line):
                return number + 1
            if section and line.strip().startswith("["):
                break
        return start + 1

    # ------------------------------------------------------------------------------ states

    def _is_described(self, state: str) -> bool:
        """Return whether a listed state is described; one that nothing reaches is left out."""
        if isinstance(self.described.get(state), dict):
            return True
        is_reached = any(
            state in self._transitions(other).values()
            for other, description in self.described.items()
            if isinstance(description, dict)
        )
        near = did_you_mean(state, [own for own in self.described if own not in self.states])
        hint = f"add [state_descriptions.{state}]" if is_reached else ""
        left_out = "" if is_reached else ", is never reached, and is left out"
        what = f"has no description{left_out}{near}"
        self._problem(self._line("states"), state, what, hint, note=not is_reached)
        return False

    def _check_state(self, state: str) -> None:
        section = f"state_descriptions.{state}"
        description = self.described.get(state)
        if state not in self.states:
            what = f"is described but not listed in states{did_you_mean(state, self.states)}"
            self._problem(self._line("", section), state[:64], what)
            return
        if not self._action(description):
            what = "has no command: state_module_name is missing"
            self._problem(self._line("", section), state, what)
        known = [*self.states, *self.outcomes]
        for transition, target in self._transitions(state).items():
            line = self._line(transition, f"{section}.transitions")
            where = f"{state}.transitions.{transition[:64]}"
            if not isinstance(target, str) or target not in known:
                shown = one_line(str(target))[:64]
                near = did_you_mean(str(target), known)
                what = f"goes to '{shown}', which is neither a state nor an outcome{near}"
                self._problem(line, where, what, f"known: {', '.join(known)}")
            elif not _NAME.fullmatch(transition):
                self._problem(line, where, "is no name of a transition")
        if not self._transitions(state):
            self._problem(self._line("", section), state, "has no transitions")

    def _transitions(self, state: str) -> Mapping[str, Any]:
        found = self.described[state].get("transitions", {})
        return found if isinstance(found, dict) else {}

    def _action(self, description: Any) -> str:
        """Return the action of a state: the last word of its module."""
        module = description.get("state_module_name")
        name = module.rpartition(".")[2].lower() if isinstance(module, str) else ""
        return name if re.fullmatch(r"[a-z][a-z0-9_]{0,63}", name) else ""

    def _first(self) -> str:
        initial = [s for s in self.states if self.described[s].get("initial_state") is True]
        if len(initial) != 1:
            first = (initial or self.states)[0]
            several = f"several states are initial ({', '.join(initial)})"
            what = f"{several if initial else 'no state is initial'}: it begins with {first}"
            self._problem(self._line("states"), "states", what, note=True)
            return first
        return initial[0]

    # ------------------------------------------------------------------------------- model

    def _model(self, first: str, title: str) -> BpmnModel:
        reached = self._reached(first)
        for state in self.states:
            if state not in reached:
                what = "is never reached, and is left out"
                line = self._line("", f"state_descriptions.{state}")
                self._problem(line, state, what, note=True)
        elements: list[Element] = []
        flows: list[Flow] = []
        begin = Element("start", "startEvent", 0, "Begin", parent="experiment", lane=_LANE)
        flows.append(_flow("start", _task(first)))
        for state in (own for own in self.states if own in reached):
            elements += self._state(state, flows)
        used = {flow.target for flow in flows}
        ends = [outcome for outcome in self.outcomes if _end(outcome) in used]
        for outcome in ends:
            name = outcome.replace("_", " ").capitalize()
            elements.append(
                Element(_end(outcome), "endEvent", 0, name, parent="experiment", lane=_LANE)
            )
        words = title.replace("_", " ").capitalize()
        process = Element(
            "experiment", "process", 0, words, executable=True,
            extension=ExtensionText(0, _yaml(self._options(words, ends, reached))),
        )  # fmt: skip
        pool = Element("pool", "participant", 0, words, process="experiment")
        lane = Element(_LANE, "lane", 0, "Robot", parent="experiment")
        every = [pool, process, lane, begin, *elements]
        return BpmnModel(
            str(self.path), {e.id: e for e in every}, {flow.id: flow for flow in flows}
        )

    def _reached(self, first: str) -> set[str]:
        found: set[str] = set()
        waiting = [first]
        while waiting:
            state = waiting.pop()
            if state not in found and state in self.states:
                found.add(state)
                waiting += self._transitions(state).values()
        return found

    def _state(self, state: str, flows: list[Flow]) -> Iterator[Element]:
        """Yield the elements of a state; add the flows that leave them."""
        name = state.replace("_", " ").capitalize()
        own, transitions = _task(state), self._transitions(state)
        task = Element(own, "serviceTask", 0, name, parent="experiment", lane=_LANE)
        others = {
            word: target for word, target in transitions.items()
            if word not in ("done", *_ERRORS)
        }  # fmt: skip
        step = self._step(state)
        if others:
            step["results"] = {_outcome(state): "outcome"}
        yield replace(task, extension=ExtensionText(0, _yaml(step)))
        errors = [word for word in _ERRORS if word in transitions]
        if errors:
            border = f"error_{state.lower()}"
            definition = EventDefinition("error", 0)
            yield Element(
                border, "boundaryEvent", 0, errors[0].capitalize(), parent="experiment",
                lane=_LANE, attached_to=own, events=(definition,),
            )  # fmt: skip
            flows.append(_flow(border, self._target(transitions[errors[0]])))
        usual = transitions.get("done", next(iter(others.values()), None))
        if not others:
            if usual is not None:
                flows.append(_flow(own, self._target(usual)))
            return
        gateway = f"outcome_{state.lower()}"
        flows.append(_flow(own, gateway))
        ways = []
        for word, target in others.items():
            condition = f"{_outcome(state)} == '{word}'"
            ways.append(_flow(gateway, self._target(target), word, condition))
        default = _flow(gateway, self._target(usual), "done")
        flows += [*ways, default]
        yield Element(
            gateway, "exclusiveGateway", 0, "Outcome?", parent="experiment", lane=_LANE,
            default=default.id,
        )  # fmt: skip

    def _target(self, name: str | None) -> str:
        return _task(str(name)) if name in self.states else _end(str(name))

    def _arguments(self, state: str) -> Mapping[str, Any]:
        found = self.described[state].get("arguments", {})
        return found if isinstance(found, dict) else {}

    def _step(self, state: str) -> dict[str, Any]:
        action = self._action(self.described[state])
        step: dict[str, Any] = {"action": action}
        parameters: dict[str, Any] = {}
        for name, value in self._arguments(state).items():
            line = self._line(name, f"state_descriptions.{state}.arguments")
            key = _parameter(name)
            if not key:
                self._problem(line, f"{state}.{name[:64]}", "cannot be the name of a parameter")
            elif name == "timeout_s" and isinstance(value, int | float):
                step["timeout"] = f"{min(float(value), LONGEST_TIMEOUT_S):g} s"
                if not 0 < value <= LONGEST_TIMEOUT_S:
                    what = f"is not above 0 and at most {LONGEST_TIMEOUT_S:g} s"
                    self._problem(line, f"{state}.timeout_s", what)
            elif isinstance(value, bool | int | float | str):
                parameters[key] = value
            else:  # the path of the planner is a list of areas
                parameters[key] = json.dumps(value, separators=(",", ":"), default=str)
        for name in self.shared:
            key = _parameter(name)
            if key and self._concerns(name, action):
                parameters.setdefault(key, f"={key}")
        if parameters:
            step["parameters"] = parameters
        return step

    def _concerns(self, argument: str, action: str) -> bool:
        """Return whether an argument of all states is for an action: ``goto_...`` for ``goto``."""
        word = argument.partition("_")[0]
        actions = [self._action(self.described[state]) for state in self.states]
        return word in action if any(word in other for other in actions) else True

    def _options(self, title: str, ends: Sequence[str], reached: set[str]) -> dict[str, Any]:
        options: dict[str, Any] = {
            "title": title, "description": f"Imported from {self.path.name}",
        }  # fmt: skip
        parameters: dict[str, Any] = {}
        for name, value in self.shared.items():
            key, line = _parameter(name), self._line(name, "arguments")
            if not key or not isinstance(value, bool | int | float | str):
                what = "is no simple value with a name, and is left out"
                self._problem(line, f"arguments.{name[:64]}", what, note=True)
            else:
                kinds = {bool: "bool", int: "int", float: "float", str: "string"}
                parameters[key] = {"type": kinds[type(value)], "default": value}
        if parameters:
            options["parameters"] = parameters
        outcomes = {_end(end): _ENDS.get(end.lower(), "passed") for end in ends}
        return {**options, "ends": outcomes} if outcomes else options


def _flow(source: str, target: str, name: str = "", condition: str = "") -> Flow:
    own = f"from_{source}_to_{target}" + (f"_{name}" if name else "")
    return Flow(own, "sequenceFlow", 0, source, target, name, "experiment", condition)


def _task(state: str) -> str:
    return f"do_{state.lower()}"


def _end(outcome: str) -> str:
    return f"end_{outcome.lower()}"


def _outcome(state: str) -> str:
    return f"outcome_of_{state.lower()}"[:64]


def _parameter(name: str) -> str:
    found = name.lower()
    return found if re.fullmatch(r"[a-z][a-z0-9_]{0,63}", found) else ""


def _yaml(values: Mapping[str, Any]) -> str:
    text: str = yaml.safe_dump(dict(values), sort_keys=False, allow_unicode=True, width=100)
    return text
