"""Procedures made without a file: small builders, and random ones with an interpreter of their own.

The interpreter knows nothing of tokens: it walks the blocks that a random procedure was made from.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from html import escape
from typing import Any

from hypothesis import strategies as st

from amberbox.core.expression import parse
from amberbox.experiments.experiment import (
    ExperimentOptions,
    FieldOptions,
    PersonStepOptions,
    RobotStepOptions,
)
from amberbox.experiments.procedure import Procedure, Step
from amberbox.experiments.workflow import Boundary, Flow, Node, NodeKind, Process

S = 1_000_000_000


def flows(path: str, *targets: str | tuple[str, str]) -> tuple[Flow, ...]:
    """Return the flows to targets; a pair is a target and its condition."""
    found = []
    for target in targets:
        name, condition = (target, "") if isinstance(target, str) else target
        parsed = parse(condition) if condition else None
        found.append(Flow(f"{path}-{name}", name, parsed))
    return tuple(found)


def node(path: str, kind: NodeKind, *targets: str | tuple[str, str], **keys: Any) -> Node:
    """Return an element with its flows; the last one without a condition is the default."""
    made = flows(path, *targets)
    plain = [flow.id for flow in made if flow.condition is None]
    default = plain[-1] if kind == "exclusive" and plain else ""
    return Node(path, kind, made, default, **keys)


def timer(path: str, seconds: float, *targets: str, interrupts: bool = True) -> Boundary:
    """Return a timer on the border of an activity."""
    return Boundary(path, flows(path, *targets), int(seconds * S), interrupts=interrupts)


def catch(path: str, code: str, *targets: str) -> Boundary:
    """Return an event on the border of an activity that catches an error."""
    return Boundary(path, flows(path, *targets), code=code)


def process(*nodes: Node) -> Process:
    """Return a process of these elements."""
    return Process({one.path: one for one in nodes})


def procedure(
    of: Process,
    forms: Mapping[str, Mapping[str, FieldOptions]] | None = None,
    robot: Mapping[str, RobotStepOptions] | None = None,
    options: ExperimentOptions | None = None,
) -> Procedure:
    """Return a procedure in which steps do what is given here, or ask nothing and do ``drive``."""
    steps = {}
    for one in of.walk():
        if one.kind == "person":
            form = PersonStepOptions(fields=(forms or {}).get(one.path, {}))
            steps[one.path] = Step(one.path, one.path, "operator", person=form)
        if one.kind == "robot":
            action = (robot or {}).get(one.path) or RobotStepOptions(action="drive")
            steps[one.path] = Step(one.path, one.path, "robot", robot=action)
    return Procedure("test", "0" * 64, of, options or ExperimentOptions(), steps)


_TAGS: Mapping[NodeKind, str] = {
    "start": "startEvent", "end": "endEvent", "error_end": "endEvent", "terminate_end": "endEvent",
    "person": "userTask", "robot": "serviceTask", "exclusive": "exclusiveGateway",
    "parallel": "parallelGateway", "timer": "intermediateCatchEvent", "inner": "subProcess",
}  # fmt: skip


def bpmn_of(of: Process) -> str:
    """Return the text of a BPMN file, without a diagram, that reads as this process."""
    codes = {node.code for node in of.walk() if node.kind == "error_end"}
    codes |= {b.code for node in of.walk() for b in node.boundaries if b.timer_ns is None}
    errors = "".join(f'<error id="e_{code}" errorCode="{code}"/>' for code in codes if code)
    space = "http://www.omg.org/spec/BPMN/20100524/MODEL"
    process = f'<process id="main" isExecutable="true">{_inside(of)}</process>'
    return f'<definitions xmlns="{space}">{errors}{process}</definitions>'


def _inside(of: Process) -> str:
    return "".join(map(_element, of.nodes.values()))


def _element(one: Node) -> str:
    flows = list(one.flows)
    definition = {
        "error_end": _error(one.code), "timer": _duration(one.timer_ns),
        "terminate_end": "<terminateEventDefinition/>",
    }.get(one.kind, "")  # fmt: skip
    events = ""
    for boundary in one.boundaries:
        what = _error(boundary.code) if boundary.timer_ns is None else _duration(boundary.timer_ns)
        stays = "" if boundary.interrupts else ' cancelActivity="false"'
        events += f'<boundaryEvent id="{boundary.path}" attachedToRef="{one.path}"{stays}>{what}'
        events += "</boundaryEvent>"
        flows += boundary.flows
    default = f' default="{one.default}"' if one.default and len(one.flows) > 1 else ""
    inner = "" if one.inner is None else _inside(one.inner)
    tag = _TAGS[one.kind]
    return f'<{tag} id="{one.path}"{default}>{definition}{inner}</{tag}>{events}' + "".join(
        f'<sequenceFlow id="{flow.id}" sourceRef="{_source(one, flow)}" targetRef="{flow.target}">'
        f"{_condition(flow)}</sequenceFlow>"
        for flow in flows
    )


def _source(one: Node, flow: Flow) -> str:
    return next((b.path for b in one.boundaries if flow in b.flows), one.path)


def _condition(flow: Flow) -> str:
    if flow.condition is None:
        return ""
    return f"<conditionExpression>{escape(flow.condition.text)}</conditionExpression>"


def _error(code: str) -> str:
    return f'<errorEventDefinition errorRef="e_{code}"/>' if code else "<errorEventDefinition/>"


def _duration(ns: int) -> str:
    text = f"PT{ns / S:g}S"
    return f"<timerEventDefinition><timeDuration>{text}</timeDuration></timerEventDefinition>"


PASS_FAIL = FieldOptions(kind="pass_fail")


@dataclass(frozen=True)
class Block:
    """A part of a random procedure.

    ``loop`` asks after its part whether to do it again; ``robot`` and ``sub`` may catch any error,
    and then do ``handler``.
    """

    kind: str
    parts: tuple[Block, ...] = ()
    handler: Block | None = None
    takes: int = 0
    name: str = ""


def blocks() -> st.SearchStrategy[Block]:
    """Return a strategy for random blocks, with names."""
    leaf = st.one_of(
        st.just(Block("person")), st.builds(Block, st.just("robot"), handler=st.just(None))
    )

    def more(inner: st.SearchStrategy[Block]) -> st.SearchStrategy[Block]:
        several = st.lists(inner, min_size=1, max_size=3).map(tuple)
        two = st.lists(inner, min_size=2, max_size=3).map(tuple)
        one = st.tuples(inner)
        handler = st.none() | inner
        return st.one_of(
            st.builds(Block, st.just("seq"), several),
            st.builds(Block, st.just("par"), two),
            st.builds(Block, st.just("xor"), two, takes=st.integers(0, 1)),
            st.builds(Block, st.just("loop"), one),
            st.builds(Block, st.just("sub"), one, handler),
            st.builds(Block, st.just("robot"), handler=inner),
        )

    return st.recursive(leaf, more, max_leaves=8).map(lambda block: _named(block, "b"))


def _named(block: Block, name: str) -> Block:
    parts = tuple(_named(part, f"{name}_{i}") for i, part in enumerate(block.parts))
    handler = None if block.handler is None else _named(block.handler, f"{name}_h")
    return replace(block, parts=parts, handler=handler, name=name)


def built(block: Block) -> Procedure:
    """Return the procedure of a block."""
    forms: dict[str, dict[str, FieldOptions]] = {}
    of = _process(block, "", forms)
    return procedure(of, forms)


def _process(block: Block, prefix: str, forms: dict[str, dict[str, FieldOptions]]) -> Process:
    nodes: list[Node] = []
    first = _build(block, f"{prefix}end", nodes, forms)
    nodes += [node(f"{prefix}start", "start", first), node(f"{prefix}end", "end")]
    return process(*nodes)


def _build(
    block: Block, then: str, nodes: list[Node], forms: dict[str, dict[str, FieldOptions]]
) -> str:
    """Add the elements of a block, which go on to another one; return where it begins."""
    name = block.name
    boundaries: tuple[Boundary, ...] = ()
    if block.handler is not None:
        nodes.append(node(f"{name}_after", "exclusive", then))
        then = f"{name}_after"
        handler = _build(block.handler, then, nodes, forms)
        boundaries = (catch(f"{name}_catch", "", handler),)
    if block.kind in ("person", "robot"):
        kind: NodeKind = "person" if block.kind == "person" else "robot"
        nodes.append(node(name, kind, then, boundaries=boundaries))
    elif block.kind == "seq":
        for part in reversed(block.parts):
            then = _build(part, then, nodes, forms)
        return then
    elif block.kind == "par":
        firsts = [_build(part, f"{name}_join", nodes, forms) for part in block.parts]
        nodes += [node(name, "parallel", *firsts), node(f"{name}_join", "parallel", then)]
    elif block.kind == "xor":
        firsts = [_build(part, f"{name}_merge", nodes, forms) for part in block.parts]
        is_first = "1 > 0" if block.takes == 0 else "1 < 0"
        nodes += [
            node(name, "exclusive", (firsts[0], is_first), *firsts[1:]),
            node(f"{name}_merge", "exclusive", then),
        ]
    elif block.kind == "loop":
        first = _build(block.parts[0], f"{name}_ask", nodes, forms)
        again = f"{name}_again"
        forms[f"{name}_ask"] = {again: PASS_FAIL}
        nodes += [
            node(name, "exclusive", first),
            node(f"{name}_ask", "person", f"{name}_decide"),
            node(f"{name}_decide", "exclusive", (name, again), then),
        ]
    else:
        inner = _process(block.parts[0], f"{name}_", forms)
        nodes.append(node(name, "inner", then, inner=inner, boundaries=boundaries))
    return name


@dataclass
class Walk:
    """A block that is being walked through: what it waits for is in it, or in those below."""

    block: Block
    below: list[Walk] = field(default_factory=list)
    at: int = 0
    is_done: bool = False
    is_handling: bool = False

    @classmethod
    def begin(cls, block: Block) -> Walk:
        """Return the walk at its first instant."""
        walk = cls(block)
        walk._enter()
        return walk

    def _enter(self) -> None:
        kind, parts = self.block.kind, self.block.parts
        if kind == "par":
            self.below = [Walk.begin(part) for part in parts]
        elif kind == "xor":
            self.below = [Walk.begin(parts[0 if self.block.takes == 0 else -1])]
        elif kind in ("seq", "sub", "loop"):
            self.below = [Walk.begin(parts[0])]

    def waiting(self) -> list[str]:
        """Return the names of the steps that wait."""
        if self.is_done:
            return []
        if self.below and not all(one.is_done for one in self.below):
            return [name for one in self.below for name in one.waiting()]
        return [f"{self.block.name}_ask" if self.block.kind == "loop" else self.block.name]

    def finish(self, name: str, again: bool) -> None:
        """End the step of a name."""
        for one in self.below:
            if name in one.waiting():
                one.finish(name, again)
                self._go_on()
                return
        if self.block.kind == "loop" and again:
            self.below = [Walk.begin(self.block.parts[0])]
        else:
            self.is_done = True

    def _go_on(self) -> None:
        if not all(one.is_done for one in self.below):
            return
        if self.is_handling:
            self.is_done = True
        elif self.block.kind == "seq" and self.at + 1 < len(self.block.parts):
            self.at += 1
            self.below = [Walk.begin(self.block.parts[self.at])]
        elif self.block.kind != "loop":
            self.is_done = True

    def fail(self, name: str) -> bool:
        """Raise an error in the step of a name; return whether something has caught it."""
        for one in self.below:
            if name in one.waiting():
                if one.fail(name):
                    self._go_on()
                    return True
                break
        if self.block.handler is None or self.is_handling:
            return False
        self.is_handling = True
        self.below = [Walk.begin(self.block.handler)]
        return True
