"""Experiments read and judged: which elements of a diagram are run, and what is wrong with it.

The profile: pools with lanes; a start event; end events, also with an error or a termination; user,
manual and service tasks; exclusive and parallel gateways; timers and errors on the border of
activities, timers between them; sub-processes; call activities. All else is drawn, and named.
Judging needs no workflow engine and runs nothing.
"""

from __future__ import annotations

import hashlib
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TypeVar

from amberbox.core.config import build
from amberbox.core.errors import Problem, UsageError, did_you_mean
from amberbox.core.expression import Expression, ExpressionError, parse
from amberbox.core.names import derive_id
from amberbox.core.safe_text import one_line
from amberbox.core.yaml_nodes import Node, load_yaml, parse_yaml
from amberbox.experiments.action import DeclaredAction, read_actions
from amberbox.experiments.bpmn import (
    ACTIVITIES,
    DATA,
    FLOW_NODES,
    SUB_PROCESSES,
    BpmnModel,
    Element,
    ExtensionText,
    Flow,
    read_bpmn,
    short_text,
    type_words,
)
from amberbox.experiments.experiment import (
    DEFAULT_ERRORS,
    ExperimentOptions,
    PersonStepOptions,
    RobotStepOptions,
    Role,
)

SUFFIX = ".bpmn"
PERSON_TASKS = frozenset({"userTask", "manualTask"})
MOST_NODES = 500
DEEPEST_CALLS = 10
LONGEST_TIMER_S = 30 * 86_400.0
MOST_PICTURE_BYTES = 5_000_000  # as many as go to a server
_PICTURE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}\.(?:png|jpe?g|svg)", re.IGNORECASE)
_VARIABLE = re.compile(r"[a-z][a-z0-9_]{0,63}")
_CODE = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_DURATION = re.compile(
    r"P(?:(?P<W>\d+)W)?(?:(?P<D>\d+)D)?"
    r"(?:T(?:(?P<H>\d+)H)?(?:(?P<M>\d+)M)?(?:(?P<S>\d+(?:\.\d{1,9})?)S)?)?"
)
_SECONDS = {"W": 604_800, "D": 86_400, "H": 3600, "M": 60, "S": 1}
_ROLE_WORDS: Mapping[str, Role] = {
    "technician": "technician",
    "operator": "operator",
    "robot": "robot",
}

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Refusal:
    """An element that is not run, and why."""

    id: str
    type: str
    name: str
    line: int
    reason: str
    hint: str = ""

    @property
    def what(self) -> str:
        """Return a sentence for messages."""
        name = f" '{one_line(self.name)}'" if self.name else ""
        return f"the {type_words(self.type)}{name} is not run: {self.reason}"


@dataclass(frozen=True)
class Experiment:
    """An experiment: its diagram and all that is declared for it.

    Steps, roles and timers are by the id of the element, conditions by the id of the flow. A call
    activity names another experiment in ``calls``; those and the ones they call are in ``called``.
    ``sha256`` is over all files of the experiment and of those it calls.
    """

    name: str
    path: Path
    model: BpmnModel
    process: str = ""
    options: ExperimentOptions = field(default_factory=ExperimentOptions)
    person_steps: Mapping[str, PersonStepOptions] = field(default_factory=dict)
    robot_steps: Mapping[str, RobotStepOptions] = field(default_factory=dict)
    roles: Mapping[str, Role] = field(default_factory=dict)
    conditions: Mapping[str, Expression] = field(default_factory=dict)
    timers_ns: Mapping[str, int] = field(default_factory=dict)
    calls: Mapping[str, str] = field(default_factory=dict)
    called: Mapping[str, Experiment] = field(default_factory=dict)
    refused: tuple[Refusal, ...] = ()
    files: tuple[Path, ...] = ()
    sha256: str = ""

    @property
    def all_files(self) -> tuple[Path, ...]:
        """Return its files and those of the experiments that it calls, each once."""
        others = (file for one in self.called.values() for file in one.all_files)
        return tuple(dict.fromkeys([*self.files, *others]))

    @property
    def title(self) -> str:
        """Return what people call it."""
        pools = (e.name for e in self.model.of_type("participant") if e.process == self.process)
        process = self.model.elements.get(self.process)
        name = "" if process is None else process.name
        return self.options.title or next(pools, "") or name or self.name

    @property
    def person_roles(self) -> tuple[Role, ...]:
        """Return the roles of the people who take part, also in experiments that it calls."""
        found = {self.roles[step] for step in self.person_steps if step in self.roles}
        found |= {role for called in self.called.values() for role in called.person_roles}
        every: tuple[Role, ...] = ("technician", "operator")
        return tuple(role for role in every if role in found)


def list_experiments(folder: Path) -> list[Path]:
    """Return the BPMN files of a folder of experiments."""
    return sorted(path for path in folder.glob(f"*{SUFFIX}") if not path.name.startswith("."))


def parse_timer(text: str) -> int:
    """Return an ISO 8601 duration, in quotes or not, in nanoseconds. Raises ValueError."""
    plain = text.strip().strip("\"'").strip()
    match = _DURATION.fullmatch(plain) if len(plain) <= 40 else None
    parts = match.groupdict() if match is not None else {}
    if not any(parts.values()):
        raise ValueError(f"'{short_text(plain)}' is no duration of ISO 8601")
    whole = sum(int(parts[key]) * _SECONDS[key] for key in "WDHM" if parts[key])
    seconds, _, fraction = (parts["S"] or "0").partition(".")
    nanoseconds = (whole + int(seconds)) * 10**9 + int(fraction.ljust(9, "0") or 0)
    if not 0 < nanoseconds <= LONGEST_TIMER_S * 10**9:
        raise ValueError(f"'{short_text(plain)}' is not above 0 and at most 30 days")
    return nanoseconds


def error_codes(step: RobotStepOptions | None) -> set[str]:
    """Return the codes of the errors that a step of the robot may raise."""
    if step is None:
        return set(DEFAULT_ERRORS.values())
    return {
        step.errors.get(trouble, code)
        for trouble, code in DEFAULT_ERRORS.items()
        if trouble != "requirement" or step.requires is not None
    }


def is_variable_of_run(address: str) -> bool:
    """Return whether an address of an expression is a variable of the run, not of the robot."""
    return re.fullmatch(r"\w+", address) is not None


def read_experiment(
    path: Path, folder: Path | None = None, *, draft: bool = False
) -> tuple[Experiment | None, list[Problem]]:
    """Read an experiment and judge it; ``folder`` is that of the robot, whose actions it uses.

    Returns all problems. With an error among them the experiment is None; with ``draft`` it is
    what could be read, to be drawn and listed, and None only if there is no diagram.
    """
    actions = read_actions(folder)[0] if folder is not None else None
    experiment, problems = _Folder(folder, actions).read(path, ())
    is_wrong = any(problem.is_error for problem in problems)
    return (None if is_wrong and not draft else experiment), problems


@dataclass(frozen=True)
class _Folder:
    """What experiments of a robot may use, and those that were read already."""

    robot: Path | None
    actions: Mapping[str, DeclaredAction] | None
    known: dict[Path, tuple[Experiment | None, list[Problem]]] = field(default_factory=dict)

    def read(
        self, path: Path, callers: tuple[Path, ...]
    ) -> tuple[Experiment | None, list[Problem]]:
        """Read an experiment once, also if several others call it."""
        if path not in self.known:
            problems: list[Problem] = []
            model = read_bpmn(path, problems)
            experiment = None
            if model is not None:
                experiment = _Reading(path, model, self, callers, problems).read()
            problems.sort(key=lambda problem: (problem.file, problem.line))
            self.known[path] = (experiment, problems)
        return self.known[path]


class _Reading:
    """Reads what is declared for one diagram, and judges it."""

    def __init__(
        self, path: Path, model: BpmnModel, folder: _Folder, callers: tuple[Path, ...],
        problems: list[Problem],
    ) -> None:  # fmt: skip
        self.path = path
        self.model = model
        self.folder = folder
        self.callers = (*callers, path.resolve())
        self.problems = problems
        self.declared: dict[str, Node] = {}  # YAML of each step
        self.refused: dict[str, Refusal] = {}
        self.options = ExperimentOptions()
        self.options_at: Node | None = None
        self.person_steps: dict[str, PersonStepOptions] = {}
        self.robot_steps: dict[str, RobotStepOptions] = {}
        self.roles: dict[str, Role] = {}
        self.conditions: dict[str, Expression] = {}
        self.timers: dict[str, int] = {}
        self.calls: dict[str, str] = {}
        self.called: dict[str, Experiment] = {}
        self.files = [path]
        self.nodes: dict[str, Element] = {}

    def read(self) -> Experiment:
        """Return the experiment as far as it can be read."""
        process = self._process()
        if process is not None:
            self.nodes = {e.id: e for e in self.model.inside(process) if e.type in FLOW_NODES}
        if process is None or not self._is_too_large(process):
            self._declarations()
            if process is not None:
                self._judge(process)
        digest = hashlib.sha256()
        for file in self.files:
            content = hashlib.sha256(file.read_bytes()).hexdigest()
            digest.update(f"{file.name}\0{content}\n".encode())
        for name, called in sorted(self.called.items()):
            digest.update(f"{name}\0{called.sha256}\n".encode())
        return Experiment(
            derive_id(self.path.name.removesuffix(SUFFIX)), self.path, self.model, process or "",
            self.options, self.person_steps, self.robot_steps, self.roles, self.conditions,
            self.timers, self.calls, self.called, tuple(self.refused.values()), tuple(self.files),
            digest.hexdigest(),
        )  # fmt: skip

    def _error(self, element: Element | Flow, what: str, hint: str = "") -> None:
        self.problems.append(Problem(str(self.path), element.line, element.id, what, hint))

    def _note(self, element: Element | Flow, what: str) -> None:
        problem = Problem(str(self.path), element.line, element.id, what, is_error=False)
        self.problems.append(problem)

    def _refuse(self, element: Element, reason: str, hint: str = "") -> None:
        """List an element that is not run; only the first reason counts."""
        if element.id not in self.refused:
            refusal = Refusal(element.id, element.type, element.name, element.line, reason, hint)
            self.refused[element.id] = refusal
            self._error(element, refusal.what, hint)

    # --------------------------------------------------------- which process is the experiment

    def _process(self) -> str | None:
        """Return the process that is run; None, and a problem, if that is not clear."""
        processes = [e for e in self.model.of_type("process") if self._has_nodes(e.id)]
        if not processes:
            what = "has no process with events and activities: there is nothing to run"
            at = next(iter(self.model.elements.values()))
            self.problems.append(Problem(str(self.path), at.line, at.id, what))
            for element in self.model.elements.values():
                if element.type not in ("process", "collaboration", "participant", "message"):
                    self._refuse(element, "an experiment is a process, with tasks of people")
            return None
        marked = [e for e in processes if e.executable]
        chosen = marked if marked else processes
        if len(chosen) > 1:
            self._several(chosen)
        if chosen[0].executable is False:
            self._note(chosen[0], 'isExecutable="false" is ignored: it is run all the same')
        for other in processes:
            if other not in chosen:
                what = "this process is only drawn: what happens there is not run or waited for"
                self._note(other, what)
        for flow in self.model.flows.values():
            if flow.type == "messageFlow":
                self._note(flow, "this message flow is only drawn: no message is sent")
        return chosen[0].id

    def _several(self, processes: Sequence[Element]) -> None:
        first, *others = processes
        names = ", ".join(process.id for process in processes)
        what = f"there are several processes, and it is not said which one is run: {names}"
        self._error(others[0], what, 'write isExecutable="true" at one of them only')
        for process in others:
            for element in self.model.children(process.id):
                if element.type in FLOW_NODES:
                    reason = f"it is in another process than '{first.id}'"
                    self._refuse(element, reason, "an experiment has one process")

    def _has_nodes(self, process: str) -> bool:
        return any(e.type in FLOW_NODES for e in self.model.children(process))

    # ------------------------------------------------------------------------- declarations

    def _declarations(self) -> None:
        """Read what is declared in the diagram and in the file beside it."""
        root = self._file_beside(self._extensions())
        if root is not None:
            built = build(ExperimentOptions, root, self.problems, "experiment")
            self.options, self.options_at = built or self.options, root
        self._check_options()
        for own, node in self.declared.items():
            self._step(self.model.elements[own], node)
        for element in self.nodes.values():
            if element.id in self.declared:
                continue
            if element.type in PERSON_TASKS:
                self.person_steps[element.id] = PersonStepOptions()
            elif element.type == "serviceTask":
                hint = f"declare it in <amberbox:step>, or in {self._beside.name}: action: ..."
                self._error(element, "this service task has no action", hint)

    def _extensions(self) -> Node | None:
        """Read the YAML in the diagram; return the options of the experiment."""
        root: Node | None = None
        for element in self.model.elements.values():
            if element.extension is None:
                continue
            node = _yaml_of(element.extension, str(self.path), self.problems)
            if node is None or node.value is None:
                continue
            if self._is_step(element) and element.id in self.nodes:
                self.declared[element.id] = node
            elif element.type not in ("process", "collaboration"):
                what = f"a {type_words(element.type)} is no step that could be declared"
                self.problems.append(node.problem(element.id, what))
            elif root is not None:
                what = f"the experiment is declared already, in line {root.line}"
                self.problems.append(node.problem("experiment", what))
            else:
                root = node
        return root

    @property
    def _beside(self) -> Path:
        return self.path.with_suffix(".yaml")

    def _file_beside(self, root: Node | None) -> Node | None:
        """Add the steps of the file beside the diagram; return the options of the experiment."""
        if not self._beside.exists():
            return root
        file = load_yaml(self._beside, self.problems)
        self.files.append(self._beside)
        if file is None or file.value is None:
            return root
        if file.mapping is None:
            what = f"expected a mapping (experiment: ..., steps: ...), got {file.kind}"
            self.problems.append(file.problem("file", what))
            return root
        known = ("experiment", "steps")
        for key, node in file.mapping.items():
            if key not in known:
                what = f"unknown key '{key}'{did_you_mean(key, known)}"
                self.problems.append(node.problem(key, what, "known keys: experiment, steps"))
        self._steps_beside(file.mapping.get("steps"))
        mine = file.mapping.get("experiment")
        if mine is not None and root is not None:
            what = f"the experiment is declared already, in {self.path.name}:{root.line}"
            self.problems.append(mine.problem("experiment", what, "declare it in one place"))
        return root if mine is None or mine.value is None else mine

    def _steps_beside(self, steps: Node | None) -> None:
        if steps is not None and steps.value is not None and steps.mapping is None:
            what = f"expected steps by the id of their element, got {steps.kind}"
            self.problems.append(steps.problem("steps", what))
        tasks = [e.id for e in self.nodes.values() if self._is_step(e)]
        for own, node in islice(_children(steps).items(), 2 * MOST_NODES):
            if own in self.declared:
                line = self.declared[own].line
                what = f"the step is declared already, in {self.path.name}:{line}"
                self.problems.append(node.problem(f"steps.{own}", what, "declare it in one place"))
            elif own not in tasks:
                what = f"the diagram has no task with this id{did_you_mean(own, tasks)}"
                hint = f"tasks: {', '.join(tasks[:20]) or 'none'}"
                self.problems.append(node.problem(f"steps.{own}", what, hint))
            else:
                self.declared[own] = node

    def _is_step(self, element: Element) -> bool:
        return element.type in PERSON_TASKS or element.type == "serviceTask"

    def _step(self, element: Element, node: Node) -> None:
        if element.type == "serviceTask":
            robot = build(RobotStepOptions, node, self.problems, element.id)
            if robot is not None:
                self.robot_steps[element.id] = robot
                self._check_robot_step(element, node, robot)
            return
        person = build(PersonStepOptions, node, self.problems, element.id)
        if person is None:
            self.person_steps[element.id] = PersonStepOptions()
            return
        self.person_steps[element.id] = person
        at = _children(node)
        if person.fields and element.type == "manualTask":
            what = "a manual task is only confirmed: it has no form"
            hint = "make it a user task in your modeller"
            self.problems.append(at.get("fields", node).problem(element.id, what, hint))
        for name, field_at in _children(at.get("fields")).items():
            self._check_variable(f"{element.id}.fields.{name}", name, field_at)
        if person.picture:
            self._picture(element.id, person.picture, at["picture"])

    def _check_variable(self, where: str, name: str, at: Node) -> None:
        if not _VARIABLE.fullmatch(name) or _is_word(name):
            hint = "a-z 0-9 _ and a letter first, and no word of the expression language"
            self.problems.append(at.problem(where, "cannot be the name of a variable", hint))

    def _picture(self, step: str, name: str, at: Node) -> None:
        where, path = f"{step}.picture", self.path.parent / name
        if not _PICTURE.fullmatch(name):
            hint = "name a PNG, JPEG or SVG file in the folder of the experiment"
            self.problems.append(at.problem(where, f"'{short_text(name)}' is no picture", hint))
        elif not path.is_file() or path.is_symlink():
            what = f"there is no file '{name}' beside the experiment"
            near = did_you_mean(name, [file.name for file in self.path.parent.iterdir()])
            self.problems.append(at.problem(where, what + near))
        elif path.stat().st_size > MOST_PICTURE_BYTES:
            what = f"'{name}' has more than {MOST_PICTURE_BYTES / 1e6:g} MB"
            self.problems.append(at.problem(where, what, "make it smaller"))
        elif path not in self.files:
            self.files.append(path)

    def _check_options(self) -> None:
        """Check what the options name in the diagram."""
        at = _children(self.options_at)
        for name, node in _children(at.get("parameters")).items():
            self._check_variable(f"experiment.parameters.{name}", name, node)
        ends = [e.id for e in self.nodes.values() if e.type == "endEvent"]
        lanes = [e.id for e in self.model.of_type("lane")]
        steps = [e.id for e in self.nodes.values() if e.type in ACTIVITIES]
        for key, known, word in (("ends", ends, "end event"), ("roles", lanes, "lane")):
            for own, node in _children(at.get(key)).items():
                if own not in known:
                    what = f"there is no {word} with this id{did_you_mean(own, known)}"
                    hint = f"{word}s: {', '.join(known) or 'none'}"
                    self.problems.append(node.problem(f"experiment.{key}.{own}", what, hint))
        criteria = at.get("criteria")
        entries = (criteria.items if criteria is not None else None) or ()
        for place, (criterion, node) in enumerate(
            zip(self.options.criteria, entries, strict=False)
        ):
            if criterion.during and criterion.during not in steps:
                near = did_you_mean(criterion.during, steps)
                what = f"there is no activity '{short_text(criterion.during)}'{near}"
                where = f"experiment.criteria[{place}].during"
                self.problems.append(_children(node).get("during", node).problem(where, what))
            local = [a for a in criterion.of.addresses() if is_variable_of_run(a)]
            if local:
                what = f"'{local[0]}' is a variable of the run, which is not recorded over time"
                hint = "name a variable of the record, such as ros_odom.twist.linear.x"
                where = f"experiment.criteria[{place}].of"
                self.problems.append(_children(node).get("of", node).problem(where, what, hint))
        for name in self.options.about:
            if not re.fullmatch(r"[a-z0-9_.-]{1,64}#[a-z0-9_.-]{1,64}", name):
                what, hint = f"'{short_text(name)}' is no failure mode", "write component#mode"
                about = at.get("about") or self.options_at
                assert about is not None  # without options there is no name
                self.problems.append(about.problem("experiment.about", what, hint))

    # ------------------------------------------------------------------ steps of the robot

    def _check_robot_step(self, element: Element, node: Node, step: RobotStepOptions) -> None:
        at = _children(node)
        for variable, key_at in _children(at.get("results")).items():
            self._check_variable(f"{element.id}.results.{variable}", variable, key_at)
        for trouble, code in step.errors.items():
            where, errors_at = f"{element.id}.errors.{trouble}", _children(at.get("errors"))
            place = errors_at.get(trouble, node)
            if trouble not in DEFAULT_ERRORS:
                near = did_you_mean(trouble, DEFAULT_ERRORS)
                what = f"there is no such kind of trouble{near}"
                hint = f"known: {', '.join(DEFAULT_ERRORS)}"
                self.problems.append(place.problem(where, what, hint))
            elif not _CODE.fullmatch(code):
                what = f"'{short_text(code)}' is no error code"
                self.problems.append(place.problem(where, what, "A-Z a-z 0-9 _ . -"))
        if step.requires is not None:
            requires_at = at.get("requires", node)
            self._check_condition(f"{element.id}.requires", step.requires, requires_at)
        if step.action:
            self._check_action(element, node, step)
        elif step.test:
            self._check_test(element, at.get("test", node), step.test)

    def _check_action(self, element: Element, node: Node, step: RobotStepOptions) -> None:
        actions = self.folder.actions
        if actions is None:
            return
        at = _children(node)
        action = actions.get(step.action)
        if action is None:
            near = did_you_mean(step.action, actions)
            what = f"the robot has no action '{short_text(step.action)}'{near}"
            hint = f"its actions: {', '.join(actions) or 'none; declare them in actions/'}"
            place = at.get("action", node)
            self.problems.append(place.problem(f"{element.id}.action", what, hint))
            return
        given_at = _children(at.get("parameters"))
        for name, value in step.parameters.items():
            where, place = f"{element.id}.parameters.{name}", given_at.get(name, node)
            if name not in action.parameters:
                near = did_you_mean(name, action.parameters)
                known = ", ".join(action.parameters) or "none"
                what = f"{action.name} has no such parameter{near}"
                self.problems.append(place.problem(where, what, f"parameters: {known}"))
            elif not (isinstance(value, str) and value.startswith("=")):
                try:
                    action.parameters[name].accept(value)
                except ValueError as error:
                    self.problems.append(place.problem(where, str(error)))
        for name, parameter in action.parameters.items():
            if parameter.default is None and name not in step.parameters:
                what = f"{action.name} needs the parameter '{name}'"
                place = at.get("parameters", node)
                self.problems.append(place.problem(f"{element.id}.parameters", what))
        if step.timeout is not None and step.timeout > action.options.timeout:
            what = f"is longer than that of {action.name}, {action.options.timeout:g} s"
            self.problems.append(at["timeout"].problem(f"{element.id}.timeout", what))

    def _check_test(self, element: Element, at: Node, name: str) -> None:
        """A test is named ``FILE.NAME``; its file has to be there."""
        if self.folder.robot is None:
            return
        place = self.folder.robot / "tests"
        stems = {
            ".".join([*path.relative_to(place).parts[:-1], _test_stem(path.stem)])
            for path in place.rglob("*.py")
        }
        if not any(name == stem or name.startswith(f"{stem}.") for stem in stems):
            near = did_you_mean(name.partition(".")[0], stems)
            what = f"the robot has no unit test '{short_text(name)}'{near}"
            hint = "it is named FILE.TEST, such as laser.rate for test_rate in tests/test_laser.py"
            self.problems.append(at.problem(f"{element.id}.test", what, hint))

    def _expressions(self) -> Iterator[tuple[str, Node, Expression]]:
        """Yield the expressions in parameters of robot steps: where, the place, what."""
        for own, step in self.robot_steps.items():
            given_at = _children(_children(self.declared[own]).get("parameters"))
            for name, value in step.parameters.items():
                if not (isinstance(value, str) and value.startswith("=")):
                    continue
                where, at = f"{own}.parameters.{name}", given_at[name]
                try:
                    yield where, at, parse(value[1:])
                except ExpressionError as error:
                    self.problems.append(at.problem(where, error.what, error.hint))

    # ---------------------------------------------------------------------- the whole graph

    def _is_too_large(self, process: str) -> bool:
        count = len(self.nodes)
        if count > MOST_NODES:
            what = f"has {count} events, activities and gateways, more than {MOST_NODES}"
            self._error(self.model.elements[process], what, "divide it with call activities")
        return count > MOST_NODES

    def _judge(self, process: str) -> None:
        for element in self.nodes.values():
            self._judge_element(element)
        for scope in (process, *(e.id for e in self.nodes.values() if e.type in SUB_PROCESSES)):
            self._judge_scope(scope)
        self._judge_drawn(process)
        self._judge_roles()
        self._judge_calls()
        self._judge_conditions()
        self._judge_variables()
        self._judge_errors(process)

    def _judge_element(self, element: Element) -> None:
        """Refuse what the profile does not have."""
        reason = _UNSUPPORTED.get(element.type)
        if reason is not None:
            self._refuse(element, *reason)
        elif element.loop:
            words = {"standard": "a loop", "parallel": "many instances at once",
                     "sequential": "many instances one after the other"}  # fmt: skip
            hint = "draw the loop with an exclusive gateway, or repeat the whole run"
            self._refuse(element, f"it is repeated ({words[element.loop]})", hint)
        elif element.compensation:
            self._refuse(element, "compensation is not supported", "draw the way back as a flow")
        elif element.triggered_by_event:
            hint = "use events on the border of activities"
            self._refuse(element, "event sub-processes are not supported", hint)
        elif element.type == "callActivity" and element.called_type.startswith("global"):
            self._refuse(element, "global tasks are not supported", "draw the task itself")
        elif element.type.endswith("Event"):
            self._judge_event(element)
        if len(self.model.outgoing(element.id)) > 1 and element.type.endswith("Event"):
            hint = "put a parallel gateway behind it"
            self._error(element, "several flows leave this event", hint)

    def _judge_event(self, element: Element) -> None:
        kinds = [definition.kind for definition in element.events]
        allowed: Mapping[str, tuple[str, ...]] = {
            "startEvent": (),
            "endEvent": ("error", "terminate"),
            "boundaryEvent": ("timer", "error"),
            "intermediateCatchEvent": ("timer",),
        }
        needs_one = element.type in ("boundaryEvent", "intermediateCatchEvent")
        if len(kinds) > 1:
            self._refuse(element, "it has several triggers", "draw an event for each")
        elif kinds and kinds[0] not in allowed[element.type]:
            may = [kind for kind in allowed[element.type] if kind != kinds[0]]
            hint = {
                "startEvent": "an experiment is begun by a person: draw a start event without one",
                "endEvent": "draw an end event without one",
            }.get(element.type, f"known there: {' and '.join(may)}")
            self._refuse(element, f"{kinds[0]} events are not supported here", hint)
        elif not kinds and needs_one:
            self._refuse(element, "it has no trigger", "make it a timer event in your modeller")
        elif kinds == ["timer"]:
            self._timer(element)

    def _timer(self, element: Element) -> None:
        timer = element.events[0]
        if timer.timer != "duration":
            word = {"date": "a date", "cycle": "a cycle"}.get(timer.timer, "no duration")
            self._error(element, f"its timer is {word}", "give a duration, such as PT2M30S")
            return
        try:
            self.timers[element.id] = parse_timer(timer.text)
        except ValueError as error:
            hint = "write PT30S for 30 seconds, PT2M for 2 minutes, P1DT6H for 30 hours"
            self._error(element, f"its timer: {error}", hint)

    def _judge_scope(self, scope: str) -> None:
        """Every element is reached from the one start, and an end can be reached from it."""
        nodes = {e.id: e for e in self.model.children(scope) if e.type in FLOW_NODES}
        starts = [e.id for e in nodes.values() if e.type == "startEvent"]
        holder = self.model.elements[scope]
        if len(starts) != 1:
            what = f"has {len(starts) or 'no'} start events" if starts else "has no start event"
            self._error(holder, what, "it begins in one place: draw one start event")
            if not starts:
                return
        for flow in self.model.flows.values():
            inside = (flow.source in nodes, flow.target in nodes)
            if flow.type == "sequenceFlow" and any(inside) and not all(inside):
                self._error(flow, "leads out of its sub-process or pool")
        after = {
            own: [f.target for f in self.model.outgoing(own) if f.target in nodes]
            + [event.id for event in self.model.boundary(own) if event.id in nodes]
            for own in nodes
        }
        reached = _reach(starts, after)
        for own, element in nodes.items():
            if own not in reached:
                self._error(element, "is never reached", "connect it, or remove it")
        before: dict[str, list[str]] = {own: [] for own in nodes}
        for own, targets in after.items():
            for target in targets:
                before[target].append(own)
        ends = [own for own in nodes if not self.model.outgoing(own)]
        leaving = _reach(ends, before)
        stuck = [own for own in nodes if own in reached and own not in leaving]
        stuck = [own for own in stuck if own in _reach(after[own], after)]  # not what leads there
        if stuck:
            names = ", ".join(stuck[:8]) + (" ..." if len(stuck) > 8 else "")
            what = f"is in a loop without a way out: {names}"
            self._error(nodes[stuck[0]], what, "draw a flow that leaves it, with a condition")

    def _judge_drawn(self, process: str) -> None:
        """Say once of each type what is only drawn."""
        told: set[str] = set()
        for element in self.model.inside(process):
            kind = element.type.removesuffix("Reference")
            if element.type in DATA and kind not in told and element.parent not in self.nodes:
                told.add(kind)
                what = f"data are only drawn: nothing is kept in this {type_words(kind)}"
                self._note(element, what)

    def _judge_roles(self) -> None:
        """Find the role of the lane of each step."""
        unclear: set[str] = set()
        for element in self.nodes.values():
            if not self._is_step(element) or element.id in self.refused:
                continue
            lane = self._lane(element)
            role = self._role_of(lane) if lane is not None else None
            if lane is not None and role is None:
                if lane.id not in unclear:
                    what = f"the role of the lane '{short_text(lane.name)}' is not clear"
                    hint = (
                        "have technician, operator or robot in its name, or declare "
                        f"experiment: roles: {{{lane.id}: operator}}"
                    )
                    self._error(lane, what, hint)
                    unclear.add(lane.id)
            elif element.type == "serviceTask":
                self.roles[element.id] = "robot"
                if role not in (None, "robot"):
                    self._note(element, f"is done by the robot, though it is in the lane of {role}")
            elif role == "robot":
                hint = "move it to the lane of a person, or make it a service task"
                self._error(
                    element, f"is a {type_words(element.type)} in the lane of a robot", hint
                )
            else:
                self.roles[element.id] = role or "operator"

    def _lane(self, element: Element) -> Element | None:
        """Return the lane of an element, or of the sub-process that it is in."""
        here: Element | None = element
        while here is not None:
            if here.lane in self.model.elements:
                return self.model.elements[here.lane]
            here = self.model.elements.get(here.parent)
        return None

    def _role_of(self, lane: Element) -> Role | None:
        """Return the role of a lane, declared or by its name; of a lane in another by that one."""
        here: Element | None = lane
        while here is not None and here.type == "lane":
            if here.id in self.options.roles:
                return self.options.roles[here.id]
            words = set(re.findall(r"[a-z]+", here.name.lower().replace("operators", "operator")))
            found = {role for word, role in _ROLE_WORDS.items() if word in words}
            if len(found) == 1:
                return found.pop()
            here = self.model.elements.get(here.parent)
        return None

    def _judge_calls(self) -> None:
        for element in self.nodes.values():
            if element.type != "callActivity" or element.id in self.refused:
                continue
            name = element.called.rpartition(":")[2]
            siblings = {path.name.removesuffix(SUFFIX): path
                        for path in list_experiments(self.path.parent)}  # fmt: skip
            if not name:
                hint = "name an experiment of this folder in calledElement"
                self._error(element, "this call activity calls nothing", hint)
            elif name not in siblings:
                what = f"there is no experiment '{short_text(name)}'{did_you_mean(name, siblings)}"
                hint = f"it has to be {short_text(name)}{SUFFIX} beside {self.path.name}"
                self._error(element, what, hint)
            elif siblings[name].resolve() in self.callers:
                ring = [path.name for path in (*self.callers, siblings[name])]
                self._error(element, f"calls itself in a circle: {' -> '.join(ring)}")
            elif len(self.callers) >= DEEPEST_CALLS:
                self._error(element, f"calls are nested more than {DEEPEST_CALLS} deep")
            else:
                self.calls[element.id] = name
                if name not in self.called:
                    self._call(element, siblings[name], name)

    def _call(self, element: Element, path: Path, name: str) -> None:
        called, problems = self.folder.read(path, self.callers)
        errors = [problem for problem in problems if problem.is_error]
        if called is not None and not errors:
            self.called |= {name: called, **called.called}
            return
        first = str(errors[0]).splitlines()[0]
        what = f"the experiment '{name}' that it calls has {len(errors)} errors, first: {first}"
        self._error(element, what, f"amberbox experiment check {path.name} names all")

    # ------------------------------------------------------------- conditions and variables

    def _judge_conditions(self) -> None:
        for element in self.nodes.values():
            outgoing = self.model.outgoing(element.id)
            with_condition = [flow for flow in outgoing if flow.condition]
            if element.type != "exclusiveGateway":
                if with_condition and element.id not in self.refused:
                    what = f"has a condition, but leaves a {type_words(element.type)}"
                    hint = "conditions are asked at exclusive gateways only"
                    self._error(with_condition[0], what, hint)
                continue
            for flow in with_condition:
                self._condition(element, flow)
            if len(outgoing) < 2 and not with_condition:
                continue
            for flow in outgoing:
                if not flow.condition and flow.id != element.default:
                    hint = "give it a condition, or make it the default flow in your modeller"
                    self._error(flow, f"has no condition, at the gateway '{element.id}'", hint)
            if not element.default and len(with_condition) == len(outgoing):
                what = "has no default flow: if no condition is true, the run cannot go on"
                hint = "make one flow the default; a skipped answer makes any condition untrue"
                self._error(element, what, hint)

    def _condition(self, gateway: Element, flow: Flow) -> None:
        if flow.id == gateway.default:
            self._note(flow, "is the default flow: its condition is not asked")
            return
        at = Node(str(self.path), flow.condition_line, flow.condition, flow.condition)
        try:
            condition = parse(flow.condition)
        except UsageError as error:
            self.problems.append(at.problem(flow.id, error.what, error.hint))
            return
        self.conditions[flow.id] = condition
        self._check_condition(flow.id, condition, at)

    def _check_condition(self, where: str, condition: Expression, at: Node) -> None:
        if condition.kind in ("number", "text", "null"):
            what = f"'{short_text(condition.text)}' is a {condition.kind}, not a condition"
            self.problems.append(at.problem(where, what, "compare it: distance_m > 0.5"))

    def given_variables(self) -> set[str]:
        """Return the variables that parameters, forms and results give, also of what is called."""
        given = set(self.options.parameters)
        for person in self.person_steps.values():
            given |= set(person.fields)
        for robot in self.robot_steps.values():
            given |= set(robot.results)
        for called in self.called.values():
            given |= set(called.options.parameters)
            for person in called.person_steps.values():
                given |= set(person.fields)
            for robot in called.robot_steps.values():
                given |= set(robot.results)
        return given

    def _judge_variables(self) -> None:
        """Every variable of the run that is read has to be given somewhere."""
        given = self.given_variables()
        reads: list[tuple[str, Node, Expression]] = []
        for own, condition in self.conditions.items():
            flow = self.model.flows[own]
            at = Node(str(self.path), flow.condition_line, flow.condition, flow.condition)
            reads.append((own, at, condition))
        for own, step in self.robot_steps.items():
            if step.requires is not None:
                at = _children(self.declared[own])["requires"]
                reads.append((f"{own}.requires", at, step.requires))
        reads += self._expressions()
        for where, at, expression in reads:
            for name in expression.addresses():
                if is_variable_of_run(name) and name not in given:
                    near = did_you_mean(name, given)
                    shown = short_text(name)
                    what = f"no parameter, form or result gives the variable '{shown}'{near}"
                    hint = f"known: {', '.join(sorted(given)) or 'none'}"
                    self.problems.append(at.problem(where, what, hint))
        for call, name in self.calls.items():
            called = self.called.get(name)
            for parameter, options in (called.options.parameters if called else {}).items():
                own_variables = given - set(called.options.parameters if called else ())
                if options.default is None and parameter not in own_variables:
                    what = f"'{name}' needs the parameter '{parameter}', which nothing gives here"
                    hint = "it takes the variable of that name: add a parameter or a field"
                    self._error(self.model.elements[call], what, hint)

    # ------------------------------------------------------------------------------- errors

    def _judge_errors(self, process: str) -> None:
        """Say which errors nothing raises, and which ones nothing catches."""
        for element in self.nodes.values():
            if element.type != "boundaryEvent" or element.id in self.refused:
                continue
            code = element.events[0].code if element.events[0].kind == "error" else ""
            activity = self.nodes.get(element.attached_to)
            raised = self._raised(activity) if activity is not None else set()
            if code and code not in raised:
                near = did_you_mean(code, raised)
                known = ", ".join(sorted(raised)) or "no error"
                self._note(element, f"nothing raises '{short_text(code)}' here{near} ({known})")
        for element in self.nodes.values():
            if element.type != "serviceTask" or element.id not in self.robot_steps:
                continue
            uncaught = self._uncaught(element)
            if uncaught:
                what = (
                    f"nothing catches {', '.join(sorted(uncaught))}: "
                    "the run then fails, and the robot is made safe"
                )
                self._note(element, what)

    def _raised(self, activity: Element) -> set[str]:
        """Return the codes of errors that an activity raises."""
        if activity.type == "serviceTask":
            return error_codes(self.robot_steps.get(activity.id))
        if activity.type == "callActivity":
            called = self.called.get(self.calls.get(activity.id, ""))
            return set() if called is None else _raised_by(called)
        inside = [e for e in self.model.children(activity.id) if e.type in FLOW_NODES]
        codes_inside = {d.code for e in inside if e.type == "endEvent" for d in e.events
                        if d.kind == "error"}  # fmt: skip
        for element in inside:
            if element.type in ACTIVITIES:
                codes_inside |= self._past_borders(element, self._raised(element))
        return codes_inside

    def _past_borders(self, activity: Element, codes: set[str]) -> set[str]:
        """Return the codes that no event on the border of an activity catches."""
        caught = {d.code for event in self.model.boundary(activity.id) for d in event.events
                  if d.kind == "error"}  # fmt: skip
        return set() if "" in caught else codes - caught

    def _uncaught(self, element: Element) -> set[str]:
        """Return the codes that leave the process from a service task."""
        codes = self._past_borders(element, self._raised(element))
        parent = self.nodes.get(element.parent)
        while parent is not None and codes:
            codes = self._past_borders(parent, codes)
            parent = self.nodes.get(parent.parent)
        return codes


def _raised_by(experiment: Experiment) -> set[str]:
    """Return the codes of errors that leave an experiment which is called."""
    ends = experiment.model.of_type("endEvent")
    codes = {d.code for end in ends for d in end.events if d.kind == "error"}
    for own, step in experiment.robot_steps.items():
        caught = {d.code for event in experiment.model.boundary(own) for d in event.events
                  if d.kind == "error"}  # fmt: skip
        codes |= set() if "" in caught else error_codes(step) - caught
    return codes


# Elements that are never run: why, and what to draw instead
_UNSUPPORTED: Mapping[str, tuple[str, str]] = {
    "task": (
        "it does not say who does it",
        "make it a user, manual or service task in your modeller",
    ),
    "scriptTask": (
        "a file that is read runs no code",
        "make it a service task with an action of the robot",
    ),
    "businessRuleTask": ("there are no decision tables", "use exclusive gateways with conditions"),
    "sendTask": ("no messages are sent", "make it a service task with an action of the robot"),
    "receiveTask": (
        "no messages are received",
        "make it a user task that confirms, or a service task",
    ),
    "intermediateThrowEvent": ("nothing is sent or raised between steps", "remove it"),
    "implicitThrowEvent": ("nothing is sent or raised between steps", "remove it"),
    "inclusiveGateway": (
        "it may take any number of its flows",
        "use exclusive gateways one after the other, or a parallel one",
    ),
    "complexGateway": ("its rule is not known", "use exclusive and parallel gateways"),
    "eventBasedGateway": (
        "it waits for one of several events",
        "use timers on the border of a step",
    ),
    "transaction": ("transactions are not supported", "make it an ordinary sub-process"),
    "adHocSubProcess": (
        "the order of its steps is open",
        "make it a sub-process with a start event and flows",
    ),
    "choreographyTask": ("choreographies are only drawn", "draw a process"),
    "subChoreography": ("choreographies are only drawn", "draw a process"),
    "callChoreography": ("choreographies are only drawn", "draw a process"),
}


def _reach(starts: Iterable[str], after: Mapping[str, Sequence[str]]) -> set[str]:
    """Return all that can be reached, the starts included."""
    found: set[str] = set()
    waiting = list(starts)
    while waiting:
        here = waiting.pop()
        if here not in found:
            found.add(here)
            waiting += after.get(here, ())
    return found


def _yaml_of(text: ExtensionText, file: str, problems: list[Problem]) -> Node | None:
    """Read the YAML in an extension element; its lines are those of the file."""
    found: list[Problem] = []
    node = parse_yaml(textwrap.dedent(text.yaml), file, found)
    problems += (replace(problem, line=problem.line + text.line - 1) for problem in found)
    return None if node is None else _moved(node, text.line - 1)


def _moved(node: Node, lines: int) -> Node:
    """Return a tree of YAML that is so many lines further down."""
    value = node.value
    if isinstance(value, dict):
        value = {key: _moved(child, lines) for key, child in value.items()}
    elif isinstance(value, tuple):
        value = tuple(_moved(child, lines) for child in value)
    return replace(node, line=node.line + lines, value=value)


def _children(node: Node | None) -> Mapping[str, Node]:
    return (node.mapping if node is not None else None) or {}


def _is_word(name: str) -> bool:
    """Return whether a name is a word of the expression language."""
    try:
        return parse(name).addresses() != (name,)
    except UsageError:
        return True


def _test_stem(stem: str) -> str:
    return stem.removeprefix("test_").removesuffix("_test")
