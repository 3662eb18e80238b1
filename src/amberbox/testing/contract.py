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
"""

from __future__ import annotations

import dataclasses
import re
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

from amberbox.core.config import build
from amberbox.core.errors import AmberboxError, Problem
from amberbox.core.options import describe
from amberbox.core.source import Power, Source, TopicOptions
from amberbox.core.types import Topic
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.testing.clock import PATIENCE_S


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

    def link_up(self, topic: str, peer: str, since_ns: int | None = None) -> None:
        self._note_link("up", topic, peer, "", since_ns or self.now_ns())

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

    Raises AssertionError with all problems found.
    """
    problems = module_problems(module, name)
    assert not problems, "\n".join(problems)
    config = sample_config(module, name)
    source = module.Source(config, name)
    problems = source_problems(source)
    assert not problems, "\n".join(problems)
    with observe(source) as sink:
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
        sample_config(module, name)
    except AssertionError as error:
        return [str(error)]
    return []


def sample_config(module: ModuleType, name: str) -> Any:
    """Build the configuration that a module's ``SAMPLE`` shows."""
    problems: list[Problem] = []
    root = parse_yaml(module.SAMPLE, f"{name}.SAMPLE", problems)
    blocks = (root.items if root is not None else None) or ()
    entries: Mapping[str, Any] = (blocks[0].mapping if len(blocks) == 1 else None) or {}
    assert list(entries) == [name], f"{name}: SAMPLE must be a list of one block '- {name}:'"
    config = build(module.Config, entries[name], problems, name)
    assert config is not None, "\n".join(str(problem) for problem in problems)
    return config


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
    return problems


@dataclass
class ObservedSink(MemorySink):
    """A sink in memory that also notes where a source breaks its contract."""

    declared: frozenset[str] = frozenset()
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
        self._last_ns[stream] = received_ns
        super().message(stream, data, received_ns)

    def link_up(self, topic: str, peer: str, since_ns: int | None = None) -> None:
        if self.declared and not any(topic.startswith(name) for name in self.declared):
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


@contextmanager
def observe(source: Source) -> Iterator[ObservedSink]:
    """Run a source in a thread; at the end stop it and check that it kept the contract.

    ``run`` may raise AmberboxError when its device is missing; any other exception fails.
    """
    sink = ObservedSink(declared=frozenset(topic.name for topic in source.topics()))
    stop = threading.Event()
    thread = threading.Thread(target=_run, args=(source, sink, stop), daemon=True)
    thread.start()
    try:
        yield sink
    finally:
        has_ended = sink.ended.is_set()
        stop.set()
        thread.join(STOP_S)
    assert not thread.is_alive(), f"run() did not return within {STOP_S} s after stop was set"
    if sink.error is not None and not isinstance(sink.error, AmberboxError):
        raise AssertionError("run() must raise nothing but AmberboxError") from sink.error
    left_up = sink.open_links() if has_ended and sink.error is None else ()
    problems = sink.problems + [
        f"{topic}: {peer} was left up at the end" for topic, peer in left_up
    ]
    assert not problems, "\n".join(problems)


def _run(source: Source, sink: ObservedSink, stop: threading.Event) -> None:
    try:
        source.run(sink, stop)
    except BaseException as error:  # the thread's error is judged by the code that started it
        sink.error = error
    finally:
        sink.ended.set()
