"""Tokens of a running experiment: which elements of its diagram are waiting, and for what.

SpiffWorkflow moves the tokens: gateways, joins, sub-processes, activities that are interrupted. It
gets neither the file nor its expressions: ``Workflow`` builds the specification from a checked
``Process``, evaluates conditions with the one expression language, and fires every event itself, at
the one element that it concerns. Time and variables are kept by the caller.
``docs/develop/notes/008-spiffworkflow.md`` has the reasons.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from amberbox.core.errors import AmberboxError
from amberbox.core.expression import Expression, Value

NodeKind: TypeAlias = Literal[
    "start", "end", "error_end", "terminate_end", "person", "robot",
    "exclusive", "parallel", "timer", "inner",
]  # fmt: skip
# Kinds at which a token stays until the caller does something
WAITING: frozenset[NodeKind] = frozenset({"person", "robot", "timer", "error_end"})

MOST_AT_ONCE = 500
"""Elements that are passed without waiting for a person, the robot or time."""
_DEEPEST = 900  # SpiffWorkflow overlooks tasks that are more than 1000 below the first


class WorkflowError(AmberboxError):
    """A diagram that cannot go on; ``element`` is the path of the element concerned."""

    def __init__(self, element: str, what: str, hint: str = "") -> None:
        self.element = element
        super().__init__(what, hint)


@dataclass(frozen=True)
class Flow:
    """A sequence flow that leaves an element; ``target`` is the path of the next one."""

    id: str
    target: str
    condition: Expression | None = None


@dataclass(frozen=True)
class Boundary:
    """An event on the border of an activity: a timer, or an error with a code (empty: any)."""

    path: str
    flows: Sequence[Flow]
    timer_ns: int | None = None
    code: str = ""
    interrupts: bool = True


@dataclass(frozen=True)
class Node:
    """An element that tokens pass; ``path`` is its id, after those of the calls it is in."""

    path: str
    kind: NodeKind
    flows: Sequence[Flow] = ()
    default: str = ""
    timer_ns: int = 0
    code: str = ""
    boundaries: Sequence[Boundary] = ()
    inner: Process | None = None


@dataclass(frozen=True)
class Process:
    """A process, a sub-process or a called experiment: its elements by path."""

    nodes: Mapping[str, Node]

    def walk(self) -> Iterator[Node]:
        """Yield all elements, those of sub-processes and called experiments after their own."""
        for node in self.nodes.values():
            yield node
            if node.inner is not None:
                yield from node.inner.walk()


@dataclass(frozen=True)
class Token:
    """A token at an element; ``id`` is the path of the element and its how-manieth visit."""

    id: str
    path: str
    kind: NodeKind | Literal["boundary"]


@dataclass(frozen=True)
class Passed:
    """An element that a token has passed; the flow that a gateway chose, and the values it read."""

    path: str
    kind: NodeKind | Literal["boundary"]
    flow: str = ""
    read: Mapping[str, Value] = field(default_factory=dict)


@dataclass
class _Plan:
    """What SpiffWorkflow carries out, and what its elements are here."""

    process: Process
    nodes: dict[str, Node] = field(default_factory=dict)
    boundaries: dict[str, Boundary] = field(default_factory=dict)
    above: dict[str, str] = field(default_factory=dict)
    conditions: dict[str, Expression] = field(default_factory=dict)
    specs: dict[str, Any] = field(default_factory=dict)


Evaluate: TypeAlias = Callable[[Expression], tuple[Value, Mapping[str, Value]]]
"""The value of an expression and the values that it has read, by name.

Raises AmberboxError where it cannot be evaluated.
"""


class Workflow:
    """The tokens of one run. Every change is followed by ``advance``.

    Raises WorkflowError where the diagram cannot go on; the workflow is of no use after that.
    """

    def __init__(
        self, process: Process, evaluate: Evaluate, state: Mapping[str, Any] | None = None
    ):
        from SpiffWorkflow.bpmn import BpmnWorkflow

        self._plan = _Plan(process)
        self._evaluate = evaluate
        self._taken: dict[str, str] = {}
        self._read: dict[str, Value] = {}
        self._passed: list[Passed] = []
        self._at_once = 0
        spec = _process_spec(self._plan, process, "")
        if state is None:
            self._visits: dict[str, int] = {}
            self._flow = BpmnWorkflow(spec, self._plan.specs, _engine(self._is_true))
        else:
            self._visits = dict(state["visits"])
            about = {"spec": spec, "subprocess_specs": self._plan.specs}
            self._flow = _serializer().from_dict({**state["tokens"], **about})
            self._flow.script_engine = _engine(self._is_true)

    def state(self) -> dict[str, Any]:
        """Return the state as plain JSON, without the diagram."""
        return {"visits": self._visits, "tokens": _serializer().to_dict(self._flow)}

    @property
    def is_completed(self) -> bool:
        """Return whether all tokens have reached an end."""
        return bool(self._flow.completed)

    def node(self, path: str) -> Node:
        """Return an element by its path."""
        return self._plan.nodes[path]

    def timer_ns(self, path: str) -> int | None:
        """Return after how long a timer fires, nanoseconds; None for an element that is none."""
        if path in self._plan.boundaries:
            return self._plan.boundaries[path].timer_ns
        node = self._plan.nodes[path]
        return node.timer_ns if node.kind == "timer" else None

    def above(self, path: str) -> str:
        """Return the path of the sub-process or call that an element is in, or nothing."""
        return self._plan.above[path]

    def advance(self) -> list[Passed]:
        """Move all tokens as far as they get; return the elements passed, in order."""
        from SpiffWorkflow.exceptions import WorkflowException

        self._passed, self._at_once = [], 0
        try:
            self._flow.do_engine_steps(self._before, self._after)
        except WorkflowException as error:
            path = getattr(getattr(error, "task_spec", None), "name", "")
            raise self._no_way(path) from error
        self._forget()
        for task in self._waiting():
            if "token" not in task.internal_data:
                path = task.task_spec.name
                self._visits[path] = self._visits.get(path, 0) + 1
                task.internal_data["token"] = f"{path}.{self._visits[path]}"
        return self._passed

    def tokens(self) -> list[Token]:
        """Return the tokens that wait, those of activities before those of events on them."""
        return [
            Token(task.internal_data["token"], task.task_spec.name, self._kind(task))
            for task in self._waiting()
        ]

    def finish(self, token: str) -> None:
        """Let the token of an activity or a timer pass, or let an event on a border happen."""
        task = self._task(token)
        if hasattr(task.task_spec, "event_definition"):
            self._fire(task)
        else:
            task.run()

    def raise_error(self, token: str, code: str) -> str | None:
        """Interrupt the activity that catches an error from inside outwards.

        Returns the path of the event that has caught it; None if nothing does.
        """
        task = self._task(token)
        while task is not None:
            for event in self._error_events(task, code):
                self._fire(event)
                return str(event.task_spec.name)
            above = task.workflow.parent_task_id
            task = None if above is None else self._flow.get_task_from_id(above)
        return None

    def _error_events(self, task: Any, code: str) -> list[Any]:
        """Return the events on the border of an activity that catch a code, the best one first."""
        found = [
            event
            for event in _border(task)
            if self._plan.boundaries[event.task_spec.name].timer_ns is None
            and self._plan.boundaries[event.task_spec.name].code in ("", code)
        ]
        return sorted(found, key=lambda e: not self._plan.boundaries[e.task_spec.name].code)

    def _fire(self, task: Any) -> None:
        from SpiffWorkflow.bpmn import BpmnEvent

        task.task_spec.catch(task, BpmnEvent(task.task_spec.event_definition))
        task.task_spec._update(task)

    def _task(self, token: str) -> Any:
        return next(task for task in self._waiting() if task.internal_data.get("token") == token)

    def _waiting(self) -> list[Any]:
        """Return the tasks of SpiffWorkflow at which a token waits, in the order of the diagram."""
        from SpiffWorkflow import TaskState

        found = self._flow.get_tasks(state=TaskState.READY | TaskState.WAITING)
        return [task for task in found if self._kind(task) in (*WAITING, "boundary")]

    def _kind(self, task: Any) -> Any:
        name = task.task_spec.name
        if name in self._plan.boundaries:
            return "boundary"
        return self._plan.nodes[name].kind if name in self._plan.nodes else ""

    def _is_true(self, flow: str, task: Any) -> bool:
        path, condition = task.task_spec.name, self._plan.conditions[flow]
        try:
            value, read = self._evaluate(condition)
        except AmberboxError as error:
            raise WorkflowError(path, error.what, error.hint) from error
        if value is not None and not isinstance(value, bool):
            raise WorkflowError(path, f"'{condition.text}' is no condition", "compare it: x > 0")
        self._read |= read
        if value:
            self._taken[path] = flow
        return value is True

    def _before(self, task: Any) -> None:
        self._at_once += 1
        path = task.task_spec.name
        if self._at_once > MOST_AT_ONCE:
            what = f"{MOST_AT_ONCE} elements were passed without a step of a person or the robot"
            raise WorkflowError(path, what, "the diagram has a loop without a way out")
        if task.depth > _DEEPEST:
            what = "parallel branches of the diagram have too many steps"
            raise WorkflowError(path, what, "join the branches before they are repeated")

    def _after(self, task: Any) -> None:
        path = task.task_spec.name
        if path in self._plan.boundaries:
            self._passed.append(Passed(path, "boundary"))
        elif path in self._plan.nodes:
            node = self._plan.nodes[path]
            flow = self._taken.pop(path, node.default) if node.kind == "exclusive" else ""
            self._passed.append(Passed(path, node.kind, flow, self._read))
            self._read = {}

    def _no_way(self, path: str) -> WorkflowError:
        what = f"no condition of the flows that leave '{path}' is true, and none is the default"
        return WorkflowError(path, what, "make one of its flows the default")

    def _forget(self) -> None:
        """Drop what was passed before the only activity that waits, so that loops do not grow.

        SpiffWorkflow keeps all tasks that were ever done as one tree, with a bounded depth.
        """
        top = self._flow
        for flow in (top, *top.subprocesses.values()):
            _drop_past(flow)
        tasks = {id for flow in (top, *top.subprocesses.values()) for id in flow.tasks}
        for id in [id for id in top.subprocesses if id not in tasks]:
            del top.subprocesses[id]


def _drop_past(flow: Any) -> None:
    from SpiffWorkflow import TaskState
    from SpiffWorkflow.bpmn.specs.control import BoundaryEventSplit, _EndJoin

    if flow.completed:
        return
    live = [
        task
        for task in flow.tasks.values()
        if task.has_state(TaskState.WAITING | TaskState.READY | TaskState.STARTED)
        and not isinstance(task.task_spec, _EndJoin)
    ]
    tops = {
        task.parent.id if isinstance(task.parent.task_spec, BoundaryEventSplit) else task.id
        for task in live
    }
    if len(tops) != 1:
        return
    kept = flow.tasks[tops.pop()]
    before = kept.parent
    root = flow.task_tree
    if before is root or before.parent is root:
        return
    below = {task.id for task in kept}
    flow.tasks = {
        id: task for id, task in flow.tasks.items() if id in below or task in (root, before)
    }
    root._children, before._parent, before._children = [before.id], root.id, [kept.id]
    flow.last_task = before


def _border(task: Any) -> Iterable[Any]:
    """Yield the events that wait on the border of an activity."""
    from SpiffWorkflow import TaskState
    from SpiffWorkflow.bpmn.specs.control import BoundaryEventSplit
    from SpiffWorkflow.bpmn.specs.defaults import BoundaryEvent

    if not isinstance(task.parent.task_spec, BoundaryEventSplit):
        return []
    return [
        event
        for event in task.parent.children
        if isinstance(event.task_spec, BoundaryEvent) and event.has_state(TaskState.WAITING)
    ]


def _process_spec(plan: _Plan, process: Process, name: str) -> Any:
    """Build the specification of a process, and those of what it contains."""
    from SpiffWorkflow.bpmn.specs import BpmnProcessSpec

    spec = BpmnProcessSpec(name=name)
    plan.above |= dict.fromkeys(process.nodes, name)
    made = {path: _node_spec(plan, spec, node) for path, node in process.nodes.items()}
    entries = {path: _with_border(plan, spec, node, made[path]) for path, node in
               process.nodes.items()}  # fmt: skip
    for path, node in process.nodes.items():
        if node.kind == "start":
            spec.start.connect(made[path])
        _connect(plan, spec, made[path], node.flows, entries, node.default)
        for boundary in node.boundaries:
            _connect(plan, spec, spec.task_specs[boundary.path], boundary.flows, entries)
    return spec


def _connect(
    plan: _Plan, spec: Any, source: Any, flows: Sequence[Flow], entries: Mapping[str, Any],
    default: str = "",
) -> None:  # fmt: skip
    for flow in flows:
        if flow.condition is None or flow.id == default:
            source.connect(entries[flow.target])
        else:
            plan.conditions[flow.id] = flow.condition
            source.connect_outgoing_if(flow.id, entries[flow.target])
    if not flows:
        source.connect(spec.end)


def _node_spec(plan: _Plan, spec: Any, node: Node) -> Any:
    from SpiffWorkflow.bpmn.specs import defaults
    from SpiffWorkflow.bpmn.specs import event_definitions as events

    plan.nodes[node.path] = node
    if node.kind == "start":
        return defaults.StartEvent(spec, node.path, events.NoneEventDefinition())
    if node.kind == "end":
        return defaults.EndEvent(spec, node.path, events.NoneEventDefinition())
    if node.kind == "terminate_end":
        return defaults.EndEvent(spec, node.path, events.TerminateEventDefinition())
    if node.kind == "timer":
        return defaults.IntermediateCatchEvent(spec, node.path, _own_event(node.path))
    if node.kind == "exclusive":
        return defaults.ExclusiveGateway(spec, node.path)
    if node.kind == "parallel":
        return defaults.ParallelGateway(spec, node.path)
    if node.inner is not None:
        plan.specs[node.path] = _process_spec(plan, node.inner, node.path)
        return defaults.SubWorkflowTask(spec, node.path, subworkflow_spec=node.path)
    return defaults.UserTask(spec, node.path)


def _with_border(plan: _Plan, spec: Any, node: Node, task: Any) -> Any:
    """Put the events of its border around an activity; return where tokens enter."""
    from SpiffWorkflow.bpmn.specs import defaults
    from SpiffWorkflow.bpmn.specs.control import BoundaryEventJoin, BoundaryEventSplit

    if not node.boundaries:
        return task
    split = BoundaryEventSplit(spec, f"{node.path} split")
    join = BoundaryEventJoin(spec, f"{node.path} join", split_task=split.name, cancel=True)
    split.connect(task)
    task.connect(join)
    for boundary in node.boundaries:
        plan.boundaries[boundary.path] = boundary
        own = _own_event(boundary.path)
        event = defaults.BoundaryEvent(spec, boundary.path, own, boundary.interrupts)
        split.connect(event)
        event.connect(join)
    return split


def _own_event(path: str) -> Any:
    """Return an event that nothing but ``Workflow`` raises, and only at one element."""
    from SpiffWorkflow.bpmn.specs.event_definitions import SignalEventDefinition

    return SignalEventDefinition(path)


def _engine(is_true: Callable[[str, Any], bool]) -> Any:
    """Return the script engine: conditions are ids of flows; there is no eval and no exec."""
    from SpiffWorkflow.bpmn.script_engine import PythonScriptEngine

    class Conditions(PythonScriptEngine):  # type: ignore[misc]  # it comes without types
        def evaluate(self, task: Any, expression: str, external_context: Any = None) -> bool:
            return is_true(expression, task)

        def execute(self, task: Any, script: str, external_context: Any = None) -> None:
            raise WorkflowError(task.task_spec.name, "scripts are not run")

        def call_service(self, task: Any, **kwargs: Any) -> None:
            raise WorkflowError(task.task_spec.name, "services are not called")

    return Conditions()


def _serializer() -> Any:
    """Return the serializer of tokens: plain JSON, without the specification."""
    from SpiffWorkflow.bpmn import BpmnWorkflow
    from SpiffWorkflow.bpmn.serializer import BpmnWorkflowSerializer
    from SpiffWorkflow.bpmn.serializer.config import DEFAULT_CONFIG
    from SpiffWorkflow.bpmn.serializer.default.workflow import (
        BpmnWorkflowConverter,
        WorkflowConverter,
    )

    class Tokens(BpmnWorkflowConverter):  # type: ignore[misc]  # it comes without types
        def to_dict(self, workflow: Any) -> dict[str, Any]:
            found: dict[str, Any] = WorkflowConverter.to_dict(self, workflow)
            return {**found, "subprocesses": self.mapping_to_dict(workflow.subprocesses)}

    config = {**DEFAULT_CONFIG, BpmnWorkflow: Tokens}
    return BpmnWorkflowSerializer(BpmnWorkflowSerializer.configure(config))
