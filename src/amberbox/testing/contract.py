"""The contract of sources, as checks that a plugin's own tests can run.

In the tests of a plugin::

    from amberbox.testing.contract import assert_source_contract, observe
    from my_package import gps

    def test_gps_is_a_source() -> None:
        assert_source_contract(gps, "gps")

    def test_gps_reads_its_device() -> None:
        with observe(gps.Source(config, "gps")) as sink:
            start_the_device()
            assert sink.wait_for("/fix", 100)

    def test_gps_reads_its_device_in_a_process() -> None:
        with observe_in_process(gps, "- gps: {device: /dev/gps0}") as sink:
            start_the_device()
            assert sink.wait_for("/fix", 100)
"""

from __future__ import annotations

import dataclasses
import re
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

from amberbox.blackbox.recorder.source_process import (
    SourceProcess,
    SourceProcessError,
    needs_process,
)
from amberbox.core.config import build
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.options import describe
from amberbox.core.robot_graph import RobotGraph
from amberbox.core.source import MOST_LATE_S, Power, Source, TopicOptions
from amberbox.core.topic_selection import TopicPattern, is_pattern
from amberbox.core.types import Topic
from amberbox.core.yaml_nodes import Node, parse_yaml
from amberbox.testing.clock import PATIENCE_S, wait_until


@dataclass
class MemorySink:
    """Stores topics, messages, links and events in the order of their calls."""

    topics: list[Topic] = field(default_factory=list)
    messages: list[tuple[int, bytes, int]] = field(default_factory=list)
    links: list[tuple[str, str, str, str, int]] = field(default_factory=list)
    """(``up`` or ``down``, topic, peer, reason, time in ns)"""
    events: list[tuple[str, str, Mapping[str, Any]]] = field(default_factory=list)
    latched: dict[str, bytes] = field(default_factory=dict)
    saved: dict[str, Any] = field(default_factory=dict)
    powers: list[tuple[Power, str]] = field(default_factory=list)
    longest_bytes: int = 64_000_000
    losses: list[tuple[str, str, int, int, int, str]] = field(default_factory=list)
    """(topic, peer, from and to in ns, how many, reason)"""
    drops: list[tuple[str, int, int, int]] = field(default_factory=list)
    """(topic, from and to in ns, how many)"""
    complete_ns: int | None = None
    """Up to when all messages have been passed on, as a source with ``late_s`` said last."""

    def __post_init__(self) -> None:
        self._lock = threading.Condition(threading.RLock())

    def now_ns(self) -> int:
        return time.time_ns()

    def topic(self, topic: Topic) -> int:
        with self._lock:
            if topic not in self.topics:
                self.topics.append(topic)
            return self.topics.index(topic)

    def message(self, stream: int, data: bytes, received_ns: int) -> None:
        with self._lock:
            self.messages.append((stream, data, received_ns))
            if self.topics[stream].latched:
                self.latched[self.topics[stream].name] = data
            self._lock.notify_all()

    def longest_message(self) -> int:
        return self.longest_bytes

    def complete(self, until_ns: int) -> None:
        self.complete_ns = until_ns

    def dropped(self, stream: int, from_ns: int, to_ns: int, count: int) -> None:
        """Note messages for which the process of a source had no room."""
        with self._lock:
            self.drops.append((self.topics[stream].name, from_ns, to_ns, count))
            self._lock.notify_all()

    def link_up(self, topic: str, peer: str, since_ns: int | None = None) -> None:
        self._note_link("up", topic, peer, "", since_ns or self.now_ns())

    def link_up_at(self, topic: str, peer: str, at_ns: int, since_ns: int | None) -> None:
        """Note a link that the process of a source reported at ``at_ns``."""
        self.link_up(topic, peer, since_ns or at_ns)

    def link_down(self, topic: str, peer: str, reason: str, since_ns: int | None = None) -> None:
        self._note_link("down", topic, peer, reason, since_ns or self.now_ns())

    def lost(
        self, topic: str, peer: str, from_ns: int, to_ns: int, count: int, reason: str
    ) -> None:
        with self._lock:
            self.losses.append((topic, peer, from_ns, to_ns, count, reason))
            self._lock.notify_all()

    def event(self, kind: str, text: str, **details: Any) -> None:
        with self._lock:
            self.events.append((kind, text, details))
            self._lock.notify_all()

    def power(self, state: Power, text: str) -> None:
        with self._lock:
            self.powers.append((state, text))
            self._lock.notify_all()

    def last_latched(self, topic: str) -> bytes | None:
        return self.latched.get(topic)

    def state(self) -> dict[str, Any]:
        return dict(self.saved)

    def save_state(self, state: Mapping[str, Any]) -> None:
        self.saved = dict(state)

    def of(self, topic: str) -> list[bytes]:
        """Return the messages of one topic in order."""
        with self._lock:
            return [data for s, data, _ in self.messages if self.topics[s].name == topic]

    def wait_for(self, topic: str, count: int, timeout_s: float = PATIENCE_S) -> list[bytes]:
        """Wait until a topic has that many messages; raise TimeoutError if it never does."""
        with self._lock:
            if not self._lock.wait_for(lambda: len(self._of(topic)) >= count, timeout_s):
                raise TimeoutError(f"{topic}: {len(self._of(topic))} of {count} messages")
        return self.of(topic)

    def _of(self, topic: str) -> list[bytes]:
        return [data for s, data, _ in self.messages if self.topics[s].name == topic]

    def _note_link(self, way: str, topic: str, peer: str, reason: str, at_ns: int) -> None:
        with self._lock:
            self.links.append((way, topic, peer, reason, at_ns))
            self._lock.notify_all()


# limit from setting ``stop`` to the return of ``run``: a second, and time for a busy machine
STOP_S = 10.0

_KIND = re.compile(r"[a-z][a-z0-9_]*")


def assert_source_contract(module: ModuleType, name: str, *, run_s: float = 0.3) -> None:
    """Check a source module: its definitions, its sample, and a run without its device.

    It runs here and in a process of its own; with a native library only there. Raises
    AssertionError with all problems found.
    """
    problems = module_problems(module, name)
    assert not problems, "\n".join(problems)
    config = sample_config(module, name)
    source = module.Source(config, name)
    problems = source_problems(source)
    assert not problems, "\n".join(problems)
    if not needs_process(module, config):
        with observe(source) as sink:
            sink.ended.wait(run_s)
        problems = _read_graph_problems(module, name, config)
        assert not problems, "\n".join(problems)
    with observe_in_process(module, module.SAMPLE) as sink:
        wait_until(lambda: sink.complete_ns or sink.ended.is_set(), "the process of the source")
        sink.ended.wait(run_s)


def module_problems(module: ModuleType, name: str) -> list[str]:
    """Return the problems of the names that a source module defines, and of their documentation."""
    missing = [n for n in ("Config", "Source", "SAMPLE") if not hasattr(module, n)]
    if missing:
        return [f"{name}: the module does not define {n}" for n in missing]
    problems = []
    if not (module.__doc__ or "").strip():
        problems.append(f"{name}: the module has no docstring; its first line is shown to users")
    config: Any = module.Config
    if not _is_frozen_dataclass(config):
        return [*problems, f"{name}: Config is not a frozen dataclass"]
    undocumented = [row.key for row in describe(config) if not row.doc]
    problems += [f"{name}: the key '{key}' has no doc" for key in undocumented]
    return problems + _sample_problems(module, name)


def _is_frozen_dataclass(cls: Any) -> bool:
    return dataclasses.is_dataclass(cls) and bool(vars(cls)["__dataclass_params__"].frozen)


def _sample_problems(module: ModuleType, name: str) -> list[str]:
    try:
        config = sample_config(module, name)
    except AssertionError as error:
        return [str(error)]
    beside: Any = getattr(module, "beside_recorder", lambda same: same)
    if not isinstance(beside(config), module.Config):
        return [f"{name}: beside_recorder() must return a Config"]
    return []


def sample_config(module: ModuleType, name: str) -> Any:
    """Build the configuration that a module's ``SAMPLE`` shows."""
    entries = _block(module.SAMPLE)
    assert list(entries) == [name], f"{name}: SAMPLE must be a list of one block '- {name}:'"
    return _configuration(module, name, entries[name])


def _block(text: str) -> Mapping[str, Node]:
    """Return the name of the one block in a list of YAML, and its node; empty if it is none."""
    root = parse_yaml(text, "black_box.yaml", [])
    blocks = (root.items if root is not None else None) or ()
    return (blocks[0].mapping if len(blocks) == 1 else None) or {}


def _configuration(module: ModuleType, name: str, node: Node) -> Any:
    problems: list[Problem] = []
    config = build(module.Config, node, problems, name)
    assert config is not None, "\n".join(str(problem) for problem in problems)
    return config


def _read_graph_problems(module: ModuleType, name: str, config: Any) -> list[str]:
    """Return the problems of a module's ``read_graph`` where nothing runs."""
    if not hasattr(module, "read_graph"):
        return []
    began_s = time.monotonic()
    try:
        graph = module.read_graph(config, 0.1)
    except AmberboxError:  # nobody answers
        return []
    if time.monotonic() - began_s > STOP_S:
        return [f"{name}: read_graph() took {time.monotonic() - began_s:.0f} s instead of 0.1 s"]
    return graph_problems(graph)


def graph_problems(graph: Any) -> list[str]:
    """Return where a graph is not as ``core.robot_graph`` states."""
    if not isinstance(graph, RobotGraph):
        return [f"read_graph() returned {type(graph).__name__} instead of a RobotGraph"]
    problems = []
    lists = {
        "nodes": graph.nodes,
        "topics": [topic.name for topic in graph.topics],
        "services": [service.name for service in graph.services],
    }
    for topic in graph.topics:
        lists[f"publishers of {topic.name}"] = topic.publishers
        lists[f"subscribers of {topic.name}"] = topic.subscribers
    for what, names in lists.items():
        if not all(isinstance(name, str) and name for name in names):
            problems.append(f"graph: {what} must be names that are not empty")
        elif list(names) != sorted(names):
            problems.append(f"graph: {what} are not sorted")
    known = {name for topic in graph.topics for name in (*topic.publishers, *topic.subscribers)}
    known |= {service.node for service in graph.services if service.node}
    missing = sorted(known - {*graph.nodes})
    return problems + [f"graph: {name} is not among the nodes" for name in missing]


def source_problems(source: Source) -> list[str]:
    """Return the problems of a source that is ready to run."""
    problems = []
    if not isinstance(getattr(source, "lossless", None), bool):
        problems.append("'lossless' must be True or False")
    topics = source.topics()
    if not all(isinstance(topic, TopicOptions) for topic in topics):
        problems.append("topics() must give TopicOptions")
    if list(topics) != list(source.topics()):
        problems.append("topics() must give the same each time")
    if not 0 <= getattr(source, "late_s", 0.0) <= MOST_LATE_S:
        problems.append(f"'late_s' must be between 0 and {MOST_LATE_S:g} s")
    return problems


@dataclass
class ObservedSink(MemorySink):
    """A sink in memory that also notes where a source breaks its contract."""

    declared: frozenset[str] = frozenset()
    late_s: float = 0.0
    """How late its messages may come, as the source states."""
    in_process: bool = False
    """Whether it runs in a process of its own, which calls ``complete`` by itself."""
    problems: list[str] = field(default_factory=list)
    ended: threading.Event = field(default_factory=threading.Event)
    """Set when ``run`` has returned or raised."""
    error: BaseException | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._last_ns: dict[int, int] = {}
        self._up: set[tuple[str, str]] = set()

    def topic(self, topic: Topic) -> int:
        if not isinstance(topic, Topic):
            self._note(f"topic() was given {topic!r}, not a Topic")
        elif topic.schema is None and topic.message_encoding not in ("json", "msgpack"):
            self._note(f"{topic.name}: only json and msgpack may come without a schema")
        return super().topic(topic)

    def message(self, stream: int, data: bytes, received_ns: int) -> None:
        if not 0 <= stream < len(self.topics):
            self._note(f"message() for stream {stream}, which topic() never returned")
            return
        name = self.topics[stream].name
        if type(data) is not bytes:
            self._note(f"{name}: data of type {type(data).__name__} instead of bytes")
        if received_ns < self._last_ns.get(stream, 0):
            self._note(f"{name}: a time of receipt lies before the one before it")
        if received_ns > time.time_ns() + 1_000_000:
            self._note(f"{name}: a time of receipt lies in the future")
        if not self.in_process and received_ns < (self.complete_ns or 0):
            self._note(f"{name}: a time of receipt lies before a call of complete()")
        self._last_ns[stream] = received_ns
        super().message(stream, data, received_ns)

    def link_up(self, topic: str, peer: str, since_ns: int | None = None) -> None:
        if self.declared and not any(_asks_for(name, topic) for name in self.declared):
            self._note(f"{topic}: was not asked for")
        self._up.add((topic, peer))
        super().link_up(topic, peer, since_ns)

    def link_down(self, topic: str, peer: str, reason: str, since_ns: int | None = None) -> None:
        if (topic, peer) not in self._up:
            self._note(f"{topic}: link_down of {peer}, which was never up")
        if not reason:
            self._note(f"{topic}: link_down without a reason")
        self._up.discard((topic, peer))
        super().link_down(topic, peer, reason, since_ns)

    def complete(self, until_ns: int) -> None:
        if not self.in_process and not self.late_s:
            self._note("complete() was called by a source without 'late_s'")
        if until_ns > time.time_ns() + 1_000_000:
            self._note("complete() was given a time in the future")
        super().complete(until_ns)

    def lost(
        self, topic: str, peer: str, from_ns: int, to_ns: int, count: int, reason: str
    ) -> None:
        if not any(known.name == topic for known in self.topics):
            self._note(f"{topic}: lost() of a topic that topic() was never given")
        if count < 1 or not reason:
            self._note(f"{topic}: lost() needs a count above 0 and a reason")
        if not 0 < from_ns <= to_ns <= time.time_ns() + 1_000_000:
            self._note(f"{topic}: lost() needs times of receipt, the earlier one first")
        super().lost(topic, peer, from_ns, to_ns, count, reason)

    def event(self, kind: str, text: str, **details: Any) -> None:
        if not _KIND.fullmatch(kind):
            self._note(f"event kind '{kind}' is no short identifier")
        if not text or "\n" in text:
            self._note(f"event '{kind}': the text must be one line for a person")
        super().event(kind, text, **details)

    def open_links(self) -> set[tuple[str, str]]:
        """Return (topic, peer) of the links that are up."""
        return set(self._up)

    def _note(self, problem: str) -> None:
        if problem not in self.problems:
            self.problems.append(problem)


def _asks_for(name: str, topic: str) -> bool:
    """Return whether a configured name asks for a topic: as a pattern, or as its beginning."""
    return TopicPattern(name).fits(topic) if is_pattern(name) else topic.startswith(name)


@contextmanager
def observe(source: Source) -> Iterator[ObservedSink]:
    """Run a source in a thread; at the end stop it and check that it kept the contract.

    ``run`` may raise AmberboxError when its device is missing; any other exception fails.
    """
    sink = _sink_for(source)
    with _observed(source, sink):
        yield sink
    if sink.late_s and sink.error is None:
        assert sink.complete_ns is not None, "'late_s' is set, but complete() was never called"


@contextmanager
def observe_in_process(
    module: ModuleType, block: str, folder: Path = Path()
) -> Iterator[ObservedSink]:
    """Run a source in a process of its own, as the recorder does; check it as ``observe`` does.

    ``block`` is its block as in ``black_box.yaml``; ``folder`` is where that file would be.
    """
    ((name, node),) = _block(block).items()
    sink = _sink_for(module.Source(_configuration(module, name, node), name))
    sink.in_process = True
    process = SourceProcess(module.__name__, name, name, node, folder, stop_s=STOP_S)
    with _observed(process, sink):
        yield sink


def _sink_for(source: Source) -> ObservedSink:
    declared = frozenset(topic.name for topic in source.topics())
    return ObservedSink(declared=declared, late_s=getattr(source, "late_s", 0.0))


class _Runs(Protocol):
    def run(self, sink: ObservedSink, stop: threading.Event) -> None: ...


@contextmanager
def _observed(source: _Runs, sink: ObservedSink) -> Iterator[None]:
    stop = threading.Event()
    thread = threading.Thread(target=_run, args=(source, sink, stop), daemon=True)
    thread.start()
    try:
        yield
    except Exception as failure:
        if sink.error is not None:
            failure.add_note(f"the source has ended before: {sink.error!r}")
        raise
    finally:
        has_ended = sink.ended.is_set()
        stop.set()
        thread.join(STOP_S + 2.0 * sink.in_process)
    assert not thread.is_alive(), f"run() did not return within {STOP_S} s after stop was set"
    if isinstance(sink.error, SourceProcessError):
        raise AssertionError("the process of the source must not die") from sink.error
    if sink.error is not None and not isinstance(sink.error, AmberboxError):
        raise AssertionError("run() must raise nothing but AmberboxError") from sink.error
    left_up = sink.open_links() if has_ended and sink.error is None else ()
    problems = sink.problems + [
        f"{topic}: {peer} was left up at the end" for topic, peer in left_up
    ]
    assert not problems, "\n".join(problems)


def _run(source: _Runs, sink: ObservedSink, stop: threading.Event) -> None:
    try:
        source.run(sink, stop)
    except BaseException as error:  # the thread's error is judged by the code that started it
        sink.error = error
    finally:
        sink.ended.set()
