"""One run of an experiment, as a state machine without input or output, clock or chance.

Everything that happens is a call with its time; what follows from it is an event in an ordered
list, from which the report is made. The state is plain JSON and can be saved and restored after
every call. Steps of the robot are handed out once: a step that has been started is never offered
again, whatever is restored.

Times are wall clock nanoseconds of the one who keeps the run; one that goes back counts as none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import msgspec
from msgspec import Struct, field

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.expression import Expression, Value, parse
from amberbox.core.safe_text import escape_hidden, one_line
from amberbox.experiments.action import accept_values
from amberbox.experiments.experiment import (
    DEFAULT_ERRORS,
    ActionTrouble,
    Outcome,
    PersonStepOptions,
    Role,
)
from amberbox.experiments.form import LONGEST_TEXT, check_form
from amberbox.experiments.procedure import Procedure, Step
from amberbox.experiments.profile import is_variable_of_run
from amberbox.experiments.workflow import Node, Passed, Token, Workflow, WorkflowError

MOST_STEPS = 10_000
"""Elements that one run passes; then it ends with an error."""
TEST_PREFIX = "test."  # of the action that runs a unit test of the robot
MOST_REPORTS = 200  # of one step of the robot
MOST_REMARKS = 500  # deviations and notes of one run
_FORMAT = 1
_LINE = 300  # characters of a name, a reason or a report
_PERSON = 128

EventKind: TypeAlias = Literal[
    "begun", "entered", "passed", "ready", "done", "started", "report", "ended", "late", "timer",
    "error", "interrupted", "deviation", "note", "paused", "resumed", "present", "over",
]  # fmt: skip
RobotEnd: TypeAlias = Literal["done"] | ActionTrouble
LiveValues: TypeAlias = Callable[[str], Value]
"""The newest value of a variable or status of the robot by its address; None if it is unknown."""


class RunEvent(Struct, frozen=True, omit_defaults=True):
    """Something that happened in a run; ``number`` counts from 1 without holes.

    ``element`` is the path of the element of the diagram, ``task`` the id of one visit of it.
    """

    number: int
    at_ns: int
    kind: EventKind
    element: str = ""
    task: str = ""
    who: str = ""
    text: str = ""
    values: dict[str, Any] = {}


@dataclass(frozen=True)
class PersonTask:
    """A step that waits for a person."""

    id: str
    step: Step
    since_ns: int

    @property
    def form(self) -> PersonStepOptions:
        """Return what it shows and asks."""
        return self.step.person or PersonStepOptions()

    @property
    def role(self) -> Role:
        """Return the least role of the person who does it."""
        return self.step.role


@dataclass(frozen=True)
class RobotTask:
    """A step that the robot is to carry out, or is carrying out (then it has a ``command``).

    ``action`` of a unit test is ``test.`` and its name.
    ``requires`` has to be true before it is started; else ``robot_ended(..., "requirement")``.
    """

    id: str
    step: Step
    since_ns: int
    action: str
    parameters: Mapping[str, Any]
    timeout_s: float | None
    requires: Expression | None
    command: str = ""


@dataclass(frozen=True)
class StopOrder:
    """An action that has to be stopped, because its step was interrupted or the run is over."""

    task: str
    element: str
    command: str
    reason: str


class _Visit(Struct):
    """A step that is not over: who waits, or what the robot does."""

    token: str
    path: str
    since_ns: int
    state: Literal["ready", "started", "stopping"] = "ready"
    parameters: dict[str, Any] = {}
    command: str = ""
    reason: str = ""
    reports: int = 0


class _State(Struct):
    sha256: str
    run: str
    robot: str
    parameters: dict[str, Any]
    variables: dict[str, Any]
    now_ns: int
    format: int = _FORMAT
    tokens: dict[str, Any] | None = None
    visits: dict[str, _Visit] = field(default_factory=dict)
    due_ns: dict[str, int] = field(default_factory=dict)
    """When timers fire, on the axis without pauses."""
    paused_ns: int = 0
    paused_since_ns: int | None = None
    steps: int = 0
    outcome: Outcome | None = None
    reasons: list[str] = field(default_factory=list)
    ends: list[str] = field(default_factory=list)
    events: list[RunEvent] = field(default_factory=list)


class ExperimentRun:
    """A run. Its methods raise UsageError for what cannot be done now, and then change nothing."""

    def __init__(self, procedure: Procedure, state: _State, live: LiveValues) -> None:
        self._procedure = procedure
        self._state = state
        self._live = live
        self._flow: Workflow | None = None
        if state.outcome is None:
            tokens = state.tokens or None
            self._flow = Workflow(procedure.process, self._evaluate, tokens)

    @classmethod
    def begin(
        cls,
        procedure: Procedure,
        run_id: str,
        robot: str,
        parameters: Mapping[str, Any],
        people: Mapping[str, str],
        now_ns: int,
        *,
        who: str = "",
        about: Mapping[str, Any] | None = None,
        live: LiveValues = lambda address: None,
    ) -> ExperimentRun:
        """Begin a run; ``people`` are names by role, ``about`` what the report has to say of it.

        Raises UsageError that names everything that is wrong with the parameters.
        """
        values = accept_values(procedure.options.parameters, parameters, procedure.name)
        variables = {**procedure.defaults, **values}
        state = _State(procedure.sha256, run_id, robot, dict(values), variables, now_ns)
        run = cls(procedure, state, live)
        present = {role: one_line(name)[:_PERSON] for role, name in people.items()}
        run._event("begun", who=who, text=procedure.options.title or procedure.name, values={
            "experiment": procedure.name, "sha256": procedure.sha256, "run": run_id,
            "robot": robot, "parameters": values, "people": present, **(about or {}),
        })  # fmt: skip
        run._settle()
        return run

    @classmethod
    def restore(
        cls, procedure: Procedure, state: bytes, live: LiveValues = lambda address: None
    ) -> ExperimentRun:
        """Continue a run from its state; raises UsageError if it is not one of this experiment."""
        try:
            found = msgspec.json.decode(state, type=_State)
        except msgspec.MsgspecError as error:
            what = f"the state of the run is damaged: {error}"
            raise UsageError(what, "abort the run and begin another") from error
        if found.format != _FORMAT:
            hint = "continue it with the version of Amberbox that began it"
            raise UsageError(f"the state of the run has format {found.format}", hint)
        if found.sha256 != procedure.sha256:
            hint = "restore the file as it was, or abort the run and begin another"
            raise UsageError(f"'{procedure.name}' has changed since the run began", hint)
        try:
            return cls(procedure, found, live)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            what = "the state of the run is damaged: its tokens cannot be read"
            raise UsageError(what, "abort the run and begin another") from error

    def state(self) -> bytes:
        """Return the state for ``restore``, as JSON."""
        self._state.tokens = None if self._flow is None else self._flow.state()
        return msgspec.json.encode(self._state)

    @property
    def id(self) -> str:
        """Return the id of the run."""
        return self._state.run

    @property
    def procedure(self) -> Procedure:
        """Return what is carried out."""
        return self._procedure

    @property
    def events(self) -> Sequence[RunEvent]:
        """Return all events, in order."""
        return self._state.events

    @property
    def variables(self) -> Mapping[str, Value]:
        """Return the values of parameters, answers and results."""
        return self._state.variables

    @property
    def outcome(self) -> Outcome | None:
        """Return how the run has ended; None while it goes on."""
        return self._state.outcome

    @property
    def reasons(self) -> Sequence[str]:
        """Return why it has ended so."""
        return self._state.reasons

    @property
    def is_paused(self) -> bool:
        """Return whether it is paused."""
        return self._state.paused_since_ns is not None

    @property
    def is_closed(self) -> bool:
        """Return whether it is over and nothing of it is still to be stopped."""
        return self._state.outcome is not None and not self._state.visits

    @property
    def next_due_ns(self) -> int | None:
        """Return when ``tick`` has to be called next; None if no timer runs."""
        if self.is_paused or not self._state.due_ns:
            return None
        return min(self._state.due_ns.values()) + self._state.paused_ns

    def person_tasks(self) -> list[PersonTask]:
        """Return the steps that wait for people."""
        return [
            PersonTask(visit.token, self._procedure.steps[visit.path], visit.since_ns)
            for visit in self._visits("person")
        ]

    def robot_tasks(self) -> list[RobotTask]:
        """Return the steps that the robot may begin now.

        There are none during a pause, and none while an action is still to be stopped.
        """
        if self.is_paused or self.stop_orders():
            return []
        return [self._robot_task(v) for v in self._visits("robot") if v.state == "ready"]

    def running(self) -> list[RobotTask]:
        """Return the steps that were started and have not ended as far as is known."""
        return [self._robot_task(v) for v in self._visits("robot") if v.state == "started"]

    def stop_orders(self) -> list[StopOrder]:
        """Return what has to be stopped; each until ``robot_ended`` is called for it."""
        return [
            StopOrder(visit.token, visit.path, visit.command, visit.reason)
            for visit in self._state.visits.values()
            if visit.state == "stopping"
        ]

    def complete(self, task: str, values: Mapping[str, Any], who: str, now_ns: int) -> None:
        """End a step of a person with the values of its form; null skips one of pass and fail.

        Raises UsageError for a step that does not wait, and that names what is wrong in the form.
        """
        self.tick(now_ns)
        visit = self._waiting(task, "person")
        form = self._procedure.steps[visit.path].person or PersonStepOptions()
        accepted = check_form(form.fields, values)
        self._state.variables.update(accepted)
        self._end_visit(visit)
        self._event("done", visit.path, task, who=who, values=accepted)
        self._running_flow().finish(task)
        self._settle()

    def robot_started(self, task: str, command: str, now_ns: int) -> None:
        """Note that a step is being started; save the state before the robot is told.

        Raises UsageError for a step that may not begin, or that was started with another command.
        """
        self.tick(now_ns)
        visit = self._state.visits.get(task)
        if visit is not None and visit.command and visit.command == command:
            return
        if visit is None or task not in {ready.id for ready in self.robot_tasks()}:
            raise UsageError(f"the step '{task}' cannot begin now", "it is offered only once")
        visit.state, visit.command = "started", command
        values = {"command": command, "parameters": visit.parameters}
        robot = self._robot_task(visit)
        self._event("started", visit.path, task, text=robot.action, values=values)

    def robot_report(self, task: str, text: str, now_ns: int) -> None:
        """Note what the robot says of a step that it carries out; the first 200 texts are kept."""
        self.tick(now_ns)
        visit = self._state.visits.get(task)
        if visit is None or not visit.command or visit.reports > MOST_REPORTS:
            return
        visit.reports += 1
        kept = text if visit.reports <= MOST_REPORTS else "further reports are not kept"
        self._event("report", visit.path, task, text=one_line(kept)[:_LINE])

    def robot_ended(
        self,
        task: str,
        state: RobotEnd,
        now_ns: int,
        reason: str = "",
        result: Mapping[str, Any] | None = None,
    ) -> None:
        """Note how a step of the robot has ended; ``outcome_unknown`` where nobody knows.

        An end that comes again, or after the step was given up, changes nothing: it is noted.
        Raises UsageError for a step that never was, or that is done without having been started.
        """
        self.tick(now_ns)
        reason, result = one_line(reason)[:_LINE], dict(result or {})
        visit = self._state.visits.get(task)
        values: dict[str, Any] = {"state": state, **({"result": result} if result else {})}
        if visit is None:
            self._note_late(task, reason, values)
            return
        step = self._procedure.steps[visit.path].robot
        if step is None:
            raise UsageError(f"the step '{task}' is not one of the robot")
        if state == "done" and not visit.command:
            raise UsageError(f"the step '{task}' was not started")
        if state == "done" and step.test and result.get("outcome") != "passed":
            state = values["state"] = "failed"
            reason = reason or one_line(str(result.get("message") or "the test has not passed"))
        self._end_visit(visit)
        self._event("ended", visit.path, task, text=reason[:_LINE], values=values)
        if visit.state == "stopping":
            return
        if state == "done":
            self._take_results(visit.path, result)
            self._running_flow().finish(task)
        else:
            self._raise(task, visit.path, self._code(visit.path, state), reason)
        self._settle()

    def deviation(self, task: str, text: str, who: str, now_ns: int) -> None:
        """Note what was not as expected in a step, past or present; raises UsageError for none."""
        path = next((e.element for e in self._state.events if e.task == task), None)
        if path is None:
            raise UsageError(f"there is no step '{one_line(task)[:64]}' in this run")
        self._written("deviation", text, who, now_ns, path, task)

    def note(self, text: str, who: str, now_ns: int) -> None:
        """Note a remark about the run."""
        self._written("note", text, who, now_ns)

    def presence(self, role: str, who: str, now_ns: int) -> None:
        """Note who is present in a role."""
        self.tick(now_ns)
        self._event("present", who=who, values={"role": one_line(role)[:_PERSON]})

    def pause(self, who: str, reason: str, now_ns: int) -> None:
        """Stop all timers, and begin no step of the robot until ``resume``."""
        self.tick(now_ns)
        if self._state.outcome is None and not self.is_paused:
            self._state.paused_since_ns = self._state.now_ns
            self._event("paused", who=who, text=one_line(reason)[:_LINE])

    def resume(self, who: str, reason: str, now_ns: int) -> None:
        """Go on after a pause."""
        self.tick(now_ns)
        if self._state.paused_since_ns is not None and self._state.outcome is None:
            self._state.paused_ns += self._state.now_ns - self._state.paused_since_ns
            self._state.paused_since_ns = None
            self._event("resumed", who=who, text=one_line(reason)[:_LINE])

    def abort(self, who: str, reason: str, now_ns: int) -> None:
        """End the run; ``stop_orders`` then lists what has to be stopped. Once is enough."""
        self._at(now_ns)  # without the timers: an abort comes before everything else
        if self._state.outcome is None:
            person, why = one_line(who)[:_PERSON], one_line(reason)[:_LINE]
            self._over("aborted", ": ".join(filter(None, (f"aborted by {person}", why))), who)

    def tick(self, now_ns: int) -> None:
        """Fire the timers that are due, in order."""
        self._at(now_ns)
        while self._state.outcome is None and not self.is_paused:
            at_ns = self._state.now_ns - self._state.paused_ns
            due = sorted((due, token) for token, due in self._state.due_ns.items() if due <= at_ns)
            if not due:
                return
            token = due[0][1]
            path = self._tokens()[token].path
            self._event("timer", path, text=self._procedure.name_of(path))
            self._running_flow().finish(token)
            self._settle()

    def _at(self, now_ns: int) -> None:
        self._state.now_ns = max(self._state.now_ns, now_ns)

    def _written(
        self, kind: EventKind, text: str, who: str, now_ns: int, path: str = "", task: str = ""
    ) -> None:
        if len(text) > LONGEST_TEXT:
            raise UsageError(f"the text has more than {LONGEST_TEXT} characters")
        if not text.strip():
            raise UsageError("the text is empty", "write what was seen")
        remarks = sum(1 for event in self._state.events if event.kind in ("deviation", "note"))
        if remarks >= MOST_REMARKS:
            raise UsageError(f"this run has {MOST_REMARKS} notes already, and takes no more")
        self.tick(now_ns)
        self._event(kind, path, task, who=who, text=escape_hidden(text))

    def _event(
        self, kind: EventKind, path: str = "", task: str = "", *, who: str = "", text: str = "",
        values: Mapping[str, Any] | None = None,
    ) -> None:  # fmt: skip
        person = one_line(who)[:_PERSON]
        events = self._state.events
        at_ns = self._state.now_ns
        made = RunEvent(len(events) + 1, at_ns, kind, path, task, person, text, dict(values or {}))
        events.append(made)

    def _running_flow(self) -> Workflow:
        assert self._flow is not None, "it is only called before the run is over"
        return self._flow

    def _tokens(self) -> dict[str, Token]:
        return {token.id: token for token in self._running_flow().tokens()}

    def _visits(self, kind: Literal["person", "robot"]) -> Iterator[_Visit]:
        steps = self._procedure.steps
        for visit in self._state.visits.values():
            if (steps[visit.path].robot is None) == (kind == "person"):
                yield visit

    def _waiting(self, task: str, kind: Literal["person", "robot"]) -> _Visit:
        for visit in self._visits(kind):
            if visit.token == task and self._state.outcome is None:
                return visit
        what = f"the step '{one_line(task)[:64]}' does not wait"
        raise UsageError(what, "it was done by another person, interrupted, or the run is over")

    def _end_visit(self, visit: _Visit) -> None:
        del self._state.visits[visit.token]

    def _robot_task(self, visit: _Visit) -> RobotTask:
        step = self._procedure.steps[visit.path]
        assert step.robot is not None, "it is a step of the robot"
        robot = step.robot
        return RobotTask(
            visit.token, step, visit.since_ns, robot.action or f"{TEST_PREFIX}{robot.test}",
            visit.parameters, robot.timeout, robot.requires, visit.command,
        )  # fmt: skip

    def _settle(self) -> None:
        """Move the tokens, and note what follows, until everything waits or the run is over."""
        while self._state.outcome is None:
            try:
                passed = self._running_flow().advance()
                self._note_passed(passed)
                tokens = self._tokens()
                self._drop_interrupted(tokens)
                self._add_new(tokens)
            except WorkflowError as error:
                self._over("error", error.what, element=error.element)
                return
            ends = [token for token in tokens.values() if token.kind == "error_end"]
            if ends:
                self._reach_error_end(ends[0])
            elif self._running_flow().is_completed:
                self._complete()
            else:
                return

    def _note_passed(self, passed: Sequence[Passed]) -> None:
        self._state.steps += len(passed)
        for one in passed:
            if one.kind in ("timer", "boundary"):
                continue  # what made it happen is an event already
            above = self._running_flow().above(one.path)
            if above and one.kind == "start":
                self._event("entered", above)
            if not above and one.kind in ("end", "terminate_end"):
                self._state.ends.append(one.path)
            values = {"flow": one.flow, "read": one.read} if one.flow else {}
            self._event("passed", one.path, values=values)

    def _drop_interrupted(self, tokens: Mapping[str, Token]) -> None:
        for token in [token for token in self._state.due_ns if token not in tokens]:
            del self._state.due_ns[token]
        gone = [v for v in self._state.visits.values() if v.token not in tokens]
        for visit in gone:
            self._interrupt(visit, "the step was interrupted")

    def _interrupt(self, visit: _Visit, reason: str) -> None:
        if visit.state == "stopping":
            return
        self._event("interrupted", visit.path, visit.token, text=reason)
        if visit.state == "started":
            visit.state, visit.reason = "stopping", reason
        else:
            self._end_visit(visit)

    def _add_new(self, tokens: Mapping[str, Token]) -> None:
        flow, now_ns = self._running_flow(), self._state.now_ns
        at_ns = (self._state.paused_since_ns or now_ns) - self._state.paused_ns
        for token in tokens.values():
            if token.id in self._state.visits or token.id in self._state.due_ns:
                continue
            timer_ns = flow.timer_ns(token.path)
            if timer_ns is not None:
                self._state.due_ns[token.id] = at_ns + timer_ns
            if token.kind in ("person", "robot"):
                self._state.steps += 1
                parameters = self._parameters(token.path)
                visit = _Visit(token.id, token.path, now_ns, parameters=parameters)
                self._state.visits[token.id] = visit
                self._event("ready", token.path, token.id)
        if self._state.steps > MOST_STEPS:
            what = f"the run has passed more than {MOST_STEPS} elements"
            hint = "the diagram has a loop without a way out"
            raise WorkflowError(self._state.events[-1].element, what, hint)

    def _parameters(self, path: str) -> dict[str, Any]:
        """Return the values of the parameters of a step of the robot."""
        robot = self._procedure.steps[path].robot
        found: dict[str, Any] = {}
        for name, given in (robot.parameters if robot is not None else {}).items():
            if not (isinstance(given, str) and given.startswith("=")):
                found[name] = given
                continue
            try:
                found[name], _ = self._evaluate(parse(given[1:]))
            except AmberboxError as error:
                raise WorkflowError(path, f"{name}: {error.what}", error.hint) from error
            if found[name] is None:
                what = f"the parameter '{name}' of '{self._procedure.name_of(path)}' has no value"
                raise WorkflowError(path, what, f"'{given[1:].strip()}' is unknown")
        return found

    def _evaluate(self, expression: Expression) -> tuple[Value, dict[str, Value]]:
        """Return the value of an expression, and the run's variables and live values in it."""
        values: dict[str, Value] = {}
        for name in expression.addresses():
            if not is_variable_of_run(name):
                values[name] = self._live(name)
            elif name in self._state.variables:
                values[name] = self._state.variables[name]
            else:
                raise UsageError(f"the variable '{name}' has no value yet", "which step gives it?")
        return expression.evaluate(values), values

    def _take_results(self, path: str, result: Mapping[str, Any]) -> None:
        robot = self._procedure.steps[path].robot
        for variable, key in (robot.results if robot is not None else {}).items():
            value: Any = result
            for part in key.split("."):
                value = value.get(part) if isinstance(value, Mapping) else None
            is_plain = isinstance(value, bool | int | float | str)
            self._state.variables[variable] = value if is_plain else None

    def _code(self, path: str, state: ActionTrouble) -> str:
        robot = self._procedure.steps[path].robot
        return (robot.errors.get(state) if robot is not None else "") or DEFAULT_ERRORS[state]

    def _raise(self, task: str, path: str, code: str, reason: str) -> None:
        """Raise an error; the run has failed if nothing catches it."""
        caught = self._running_flow().raise_error(task, code)
        values = {"code": code, **({} if caught is None else {"caught": caught})}
        self._event("error", path, task, text=reason, values=values)
        if caught is None:
            about = f"{self._procedure.name_of(path)}: {reason or code}"
            self._over("failed", f"{about} (nothing catches '{code}')", element=path)

    def _reach_error_end(self, token: Token) -> None:
        code = self._running_flow().node(token.path).code
        caught = self._running_flow().raise_error(token.id, code)
        values = {"code": code, **({} if caught is None else {"caught": caught})}
        self._event("error", token.path, token.id, values=values)
        if caught is None:
            self._state.ends.append(token.path)
            declared = self._procedure.options.ends.get(token.path, "failed")
            self._over(declared, self._procedure.name_of(token.path), element=token.path)

    def _complete(self) -> None:
        """End the run as the ends that it has reached say."""
        ends = self._procedure.options.ends
        declared = [(ends[path], path) for path in self._state.ends if path in ends]
        failed = [text for text, answer in self._answers().items() if answer is False]
        for outcome in ("aborted", "failed", "passed"):
            named = [self._procedure.name_of(path) for o, path in declared if o == outcome]
            if named:
                self._over(outcome, "; ".join(named))
                return
        if failed:
            self._over("failed", "; ".join(f"{text}: fail" for text in failed))
        else:
            names = dict.fromkeys(self._procedure.name_of(path) for path in self._state.ends)
            self._over("passed", "; ".join(names))

    def _answers(self) -> dict[str, bool | None]:
        """Return the last answer to each question of pass and fail, by its text."""
        found: dict[str, bool | None] = {}
        for event in self._state.events:
            form = self._procedure.steps[event.element].person if event.kind == "done" else None
            for name, one in (form.fields if form is not None else {}).items():
                if one.kind == "pass_fail":
                    text = one.label or name
                    found[f"{self._procedure.name_of(event.element)}, {text}"] = event.values[name]
        return found

    def _over(self, outcome: Outcome, reason: str, who: str = "", element: str = "") -> None:
        self._state.outcome, self._flow = outcome, None
        self._state.reasons.append(reason)
        self._state.due_ns.clear()
        for visit in list(self._state.visits.values()):
            self._interrupt(visit, f"the run is over: {reason}"[:_LINE])
        skipped = [text for text, answer in self._answers().items() if answer is None]
        values = {"outcome": outcome, **({"skipped": skipped} if skipped else {})}
        self._event("over", element, who=who, text=reason, values=values)

    def _note_late(self, task: str, reason: str, values: Mapping[str, Any]) -> None:
        known = [event for event in self._state.events if event.task == task]
        if not known:
            raise UsageError(f"there is no step '{one_line(task)[:64]}' in this run")
        again = [e for e in known if e.kind in ("ended", "late") and e.values == values]
        if not again:
            self._event("late", known[0].element, task, text=reason, values=values)


def state_of_events(events: Sequence[RunEvent]) -> bytes:
    """Return the state of a run that is over, for ``restore``, from its events.

    Raises UsageError for events that are not all of a run, from its begin to its end.
    """
    over = next((event for event in events if event.kind == "over"), None)
    is_whole = [event.number for event in events] == [*range(1, len(events) + 1)]
    if over is None or over.values.get("outcome") is None or not is_whole:
        raise UsageError("these are not all events of a run that is over")
    begun = {key: events[0].values.get(key) for key in ("sha256", "run", "robot", "parameters")}
    state = {
        **begun, "variables": {}, "now_ns": events[-1].at_ns, "reasons": [over.text],
        "outcome": over.values.get("outcome"), "events": msgspec.to_builtins(events),
    }  # fmt: skip
    try:
        return msgspec.json.encode(msgspec.convert(state, _State))
    except msgspec.MsgspecError as error:
        raise UsageError(f"these are no events of a run: {error}") from error


ElementState: TypeAlias = Literal["current", "waiting", "done", "failed"]
_STATES: Mapping[EventKind, ElementState] = {
    "entered": "current", "passed": "done", "ready": "current", "done": "done", "timer": "done",
    "started": "current", "error": "failed", "interrupted": "failed",
}  # fmt: skip


def element_states(
    procedure: Procedure, events: Sequence[RunEvent]
) -> dict[str, ElementState]:  # fmt: skip
    """Return the states of elements and flows that a run has come to, for its diagram, by path."""
    states: dict[str, ElementState] = {}
    activities = {
        boundary.path: node
        for node in procedure.process.walk()
        for boundary in node.boundaries
        if boundary.interrupts
    }
    for event in events:
        step = procedure.steps.get(event.element)
        state = _STATES.get(event.kind)
        if event.kind == "ready" and step is not None and step.robot is not None:
            state = "waiting"
        if event.kind == "ended":
            state = "done" if event.values["state"] == "done" else "failed"
        if state is not None and event.element:
            states[event.element] = state
        if event.values.get("flow"):
            states[event.values["flow"]] = "done"
        caught = event.values.get("caught", event.element if event.kind == "timer" else "")
        if caught:
            states[caught] = "done"
        if caught in activities:
            states |= _given_up(activities[caught], states)
    return states


def _given_up(activity: Node, states: Mapping[str, ElementState]) -> dict[str, ElementState]:
    """Return the states of an activity that is interrupted, and of what goes on in it."""
    inside = [] if activity.inner is None else activity.inner.walk()
    going_on = [n.path for n in inside if states.get(n.path) in ("current", "waiting")]
    return dict.fromkeys([activity.path, *going_on], "failed")
