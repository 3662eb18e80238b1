"""The draft of a robot: a component per node, its signs of life, and what it seems to need."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from amberbox.agent.commissioning.observation import (
    CALL_TYPES,
    DIAGNOSTIC_TYPES,
    GOAL_TYPES,
    LOG_TYPES,
    DiagnosticEntry,
    ObservedTopic,
    RobotObservation,
    full_type,
)
from amberbox.agent.commissioning.rate import LearnedRate
from amberbox.core.names import derive_id, readable_identifier
from amberbox.core.robot_graph import GraphTopic
from amberbox.core.safe_text import one_line

# nodes of a moment: rospy's and roscpp's anonymous names, tools, and helpers within other nodes
_PASSING = re.compile(
    r"_\d{9,}$|_gui_(py|cpp)_node_\d+$|/_|/launch_ros_\d+$|/transform_listener_impl_\w+$"
)
_OWN = re.compile(r"/amberbox(_\w+)?$")
# what most nodes send or listen to: no sign of who needs whom
_COMMON = re.compile(
    r"/(rosout(_agg)?|clock|tf(_static)?|diagnostics(_agg|_toplevel_state)?|bond)$"
)
_COMMON_ENDS = ("/parameter_descriptions", "/parameter_updates", "/parameter_events")
# orders: who obeys them does well without
_ORDERS = re.compile(r"(cmd|command|goal|setpoint|joy|teleop)", re.IGNORECASE)
_ORDER_TYPES = re.compile(r"/(Twist(Stamped)?|Ackermann\w*|Joy|JointTrajectory|\w*(Command|Goal))$")
_LEFT_OUT = re.compile(r"/(rosout_agg|statistics)$")
# further forms of an image topic: who listens to them makes a node compress
_IMAGE_FORMS = ("/compressed", "/compressedDepth", "/theora", "/zstd", "/ffmpeg")
_SERVICE_EVENT = "/_service_event"
_BIG_BYTES_S = 1_000_000
_MOST_ENTRIES = 200


@dataclass(frozen=True, slots=True)
class RecordedTopic:
    """A topic to record; a big one is kept in the ring only, and thinned."""

    name: str
    type: str
    remark: str
    is_big: bool = False


@dataclass(frozen=True, slots=True)
class DiagnosticSign:
    """Which entries of the diagnostics belong to a component, and what is expected of them."""

    patterns: tuple[str, ...]
    """Regular expressions, as the mode ``diagnostics`` takes them."""
    max_age_s: float = 5.0
    count: int | None = None
    absent_ok: bool = False


@dataclass(frozen=True, slots=True)
class GuessedNeed:
    """A component that another one seems to need, because it listens to a topic of it."""

    component: str
    topic: str


@dataclass(frozen=True)
class DraftedComponent:
    """A component, and the signs by which it is watched."""

    id: str
    what: str
    node: str = ""
    """Its name on the bus; empty where it stands for no node."""
    rates: Mapping[str, LearnedRate] = field(default_factory=dict)
    log_name: str = ""
    """The name under which it writes errors into the log; empty where there is no log."""
    diagnostics: DiagnosticSign | None = None
    goals: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    """Its topics with statuses of goals, and the statuses that are failures."""
    calls: tuple[str, ...] = ()
    """Its topics with events of services whose answers say whether a call failed."""
    needs: tuple[GuessedNeed, ...] = ()
    parts: tuple[str, ...] = ()
    """Components that it consists of; it has no signs of its own then."""
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True)
class RobotDraft:
    """What a robot folder will hold, and what a person should know of it."""

    components: tuple[DraftedComponent, ...]
    topics: tuple[RecordedTopic, ...]
    log_topic: str = ""
    log_level: int = 0
    diagnostics_topic: str = ""
    remarks: tuple[str, ...] = ()


def topics_to_listen(topics: Iterable[GraphTopic]) -> list[GraphTopic]:
    """Return the topics worth recording: without copies, and what only a listener would start."""
    listed = list(topics)
    names = {topic.name for topic in listed}
    return [topic for topic in listed if not _is_left_out(topic.name, names)]


def _is_left_out(name: str, names: Collection[str]) -> bool:
    if _LEFT_OUT.search(name):
        return True
    base, _, _ = name.rpartition("/")
    return name.endswith(_IMAGE_FORMS) and base in names


def draft_of(seen: RobotObservation) -> RobotDraft:
    """Make components of the nodes that were seen, and choose what to record."""
    return _Drafting(seen).draft()


class _Drafting:
    """The tables that the parts of a draft share."""

    def __init__(self, seen: RobotObservation) -> None:
        self.seen = seen
        self.heard = {topic.name: topic for topic in seen.topics}
        known = {topic.name: topic for topic in seen.graph.topics}
        known |= {name: GraphTopic(name) for name in self.heard if name not in known}
        self.topics = topics_to_listen(known[name] for name in sorted(known))
        self.types = {t.name: self._type(t) for t in self.topics}
        self.nodes = [n for n in seen.graph.nodes if not _PASSING.search(n) and not _OWN.search(n)]
        self.ids = _ids(self.nodes)
        self.owned: dict[str, list[ObservedTopic]] = defaultdict(list)
        self.remarks: list[str] = []
        self.of_node: dict[str, list[str]] = defaultdict(list)

    def draft(self) -> RobotDraft:
        """Put the parts together."""
        self._say_what_is_left_out()
        self._share_out()
        self._say_what_is_wrong_already()
        entries = self._entries_by_component()
        needs = dict(self._needs())
        log, diagnostics = self._first(LOG_TYPES), self._first(DIAGNOSTIC_TYPES)
        components = [
            DraftedComponent(
                id=self.ids[node],
                what=f"the node {one_line(node)}",
                node=node,
                rates={t.name: t.rate for t in self.owned[node] if t.rate is not None},
                log_name=self._log_name(node) if log else "",
                diagnostics=entries.pop(self.ids[node], None),
                goals=self._goals(node),
                calls=self._calls(node),
                needs=needs.get(node, ()),
                remarks=tuple(self.of_node[node]),
            )
            for node in self.nodes
        ]
        components += self._of_no_node()
        taken = {component.id for component in components}
        components += [
            DraftedComponent(
                free_name(name, taken), "part that reports diagnostics", diagnostics=sign
            )
            for name, sign in entries.items()
        ]
        return RobotDraft(
            tuple(components),
            tuple(self._recorded(topic) for topic in self.topics),
            log,
            LOG_TYPES.get(full_type(self.types.get(log, "")), 0),
            diagnostics,
            tuple(self.remarks),
        )

    def _type(self, topic: GraphTopic) -> str:
        """Return the type as the messages spell it, else as ROS 1 or 2 does."""
        heard = self.heard.get(topic.name)
        if heard is not None and heard.type:
            return heard.type
        return topic.type.replace("/msg/", "/") if self.seen.plugin == "ros" else topic.type

    def _first(self, types: Collection[str]) -> str:
        """Return the topic of a type, that of the usual name where there are several."""
        found = [t.name for t in self.topics if full_type(self.types[t.name]) in types]
        return min(found, key=lambda name: (name.count("/"), len(name)), default="")

    def _say_what_is_left_out(self) -> None:
        passing = [n for n in self.seen.graph.nodes if _PASSING.search(n)]
        if passing:
            self.remarks.append(f"left out as tools of a moment: {_some(passing)}")

    def _share_out(self) -> None:
        """Give each topic with one publisher to it, and say why others are watched for nobody."""
        shared, silent, irregular = [], [], []
        for topic in self.topics:
            heard = self.heard.get(topic.name)
            publishers = [node for node in topic.publishers if node in self.ids]
            if not publishers or _is_common(topic.name):
                continue
            if len(publishers) > 1:
                shared.append(topic.name)
            elif heard is not None and heard.rate is not None:
                self.owned[publishers[0]].append(heard)
            elif heard is None or not heard.count:
                silent.append(f"{topic.name} ({publishers[0]})")
                self.of_node[publishers[0]].append(
                    f"{topic.name}: no message in {self.seen.seconds:g} s, so not watched"
                )
            else:
                irregular.append(topic.name)
                what = "latched" if heard.latched else f"{heard.count} messages without a rhythm"
                self.of_node[publishers[0]].append(f"{topic.name}: {what}, so not watched")
        if self.seen.seconds:
            self._say_who_is_not_watched(silent, irregular, shared)

    def _say_who_is_not_watched(
        self, silent: Sequence[str], irregular: Sequence[str], shared: Sequence[str]
    ) -> None:
        if silent:
            self.remarks.append(
                f"no message in {self.seen.seconds:g} s, which may be a fault or not: "
                f"{_some(silent)}; not watched"
            )
        if irregular:
            self.remarks.append(f"latched or irregular, not watched: {_some(irregular)}")
        if shared:
            self.remarks.append(f"several publishers, watched for none of them: {_some(shared)}")

    def _say_what_is_wrong_already(self) -> None:
        for writer, count in sorted(self.seen.errors.items()):
            lines = "error" if count == 1 else "errors"
            self.remarks.append(f"{one_line(writer)} logged {count} {lines} while listening")
        for entry in self.seen.entries:
            if entry.level:
                word = {1: "WARN", 2: "ERROR", 3: "STALE"}.get(entry.level, str(entry.level))
                self.remarks.append(f"diagnostics of '{one_line(entry.name)}': {word} already")

    def _log_name(self, node: str) -> str:
        """Return the name in the log: that of the node, with dots in ROS 2."""
        return node if self.seen.plugin == "ros" else node.strip("/").replace("/", ".")

    def _goals(self, node: str) -> dict[str, tuple[int, ...]]:
        return {
            topic.name: GOAL_TYPES[full_type(self.types[topic.name])]
            for topic in self.topics
            if topic.publishers == (node,) and full_type(self.types[topic.name]) in GOAL_TYPES
        }

    def _calls(self, node: str) -> tuple[str, ...]:
        """Return the topics with events of a node's services; their clients may send them, too."""
        served = {
            f"{one.name}{_SERVICE_EVENT}" for one in self.seen.graph.services if one.node == node
        }
        return tuple(
            topic.name
            for topic in self.topics
            if topic.name in served and self.types[topic.name] in CALL_TYPES
        )

    def _entries_by_component(self) -> dict[str, DiagnosticSign]:
        """Return the names of diagnostics by component; entries of no node have one of their own.

        A node is found by the words before the colon of a name, which its updater writes, by the
        hardware id, or because it alone publishes diagnostics.
        """
        publishers = {
            node
            for topic in self.topics
            if full_type(self.types[topic.name]) in DIAGNOSTIC_TYPES
            for node in topic.publishers
            if node in self.ids
        }
        found: dict[str, list[str]] = defaultdict(list)
        if len(self.seen.entries) > _MOST_ENTRIES:
            self.remarks.append(f"diagnostics: only {_MOST_ENTRIES} entries are watched")
        for entry in self.seen.entries[:_MOST_ENTRIES]:
            node = self._node_of(entry, publishers)
            group = entry.name.partition(":")[0].strip() or entry.hardware_id or "diagnostics"
            found[self.ids[node] if node else id_of(group)].append(entry.name)
        return {
            name: DiagnosticSign(tuple(f"^{escaped(entry)}$" for entry in dict.fromkeys(entries)))
            for name, entries in found.items()
        }

    def _node_of(self, entry: DiagnosticEntry, publishers: Collection[str]) -> str:
        words = (entry.name.partition(":")[0], entry.hardware_id)
        for node in (*sorted(publishers), *self.nodes):
            names = {node, node.strip("/"), node.rpartition("/")[2]}
            if any(word.strip() in names for word in words if word.strip()):
                return node
        return next(iter(publishers)) if len(publishers) == 1 else ""

    def _needs(self) -> Iterator[tuple[str, tuple[GuessedNeed, ...]]]:
        """Guess who needs whom: a node needs the one publisher of a steady or latched topic.

        Orders, such as speeds, are no need. Of a circle one guess is left out: that towards the
        node that itself listens to most.
        """
        topic_of: dict[tuple[str, str], str] = {}
        for topic in self.topics:
            heard = self.heard.get(topic.name)
            is_steady = heard is not None and (heard.rate is not None or heard.latched)
            is_order = _ORDERS.search(topic.name) or _ORDER_TYPES.search(self.types[topic.name])
            if len(topic.publishers) != 1 or not is_steady or is_order or _is_common(topic.name):
                continue
            (source,) = topic.publishers
            for node in topic.subscribers:
                if node != source and node in self.ids and source in self.ids:
                    topic_of.setdefault((node, source), topic.name)
        listens: dict[str, int] = defaultdict(int)
        for node, _ in topic_of:
            listens[node] += 1
        kept: dict[str, set[str]] = defaultdict(set)
        needs: dict[str, list[GuessedNeed]] = defaultdict(list)
        for node, source in sorted(topic_of, key=lambda pair: (listens[pair[1]], pair)):
            if _reaches(kept, source, node):
                self.of_node[node].append(
                    f"it listens to {topic_of[node, source]} of {self.ids[source]}, too, "
                    "which needs it in turn"
                )
                continue
            kept[node].add(source)
            needs[node].append(GuessedNeed(self.ids[source], topic_of[node, source]))
        for node, found in needs.items():
            yield node, tuple(sorted(found, key=lambda need: need.component))

    def _of_no_node(self) -> Iterator[DraftedComponent]:
        """Yield a component for each group of topics whose publisher the bus does not tell."""
        groups: dict[str, dict[str, LearnedRate]] = defaultdict(dict)
        for topic in self.topics:
            heard = self.heard.get(topic.name)
            if topic.publishers or heard is None or heard.rate is None or _is_common(topic.name):
                continue
            groups[topic.name.strip("/").partition("/")[0]][topic.name] = heard.rate
        taken = set(self.ids.values())
        for name, rates in sorted(groups.items()):
            yield DraftedComponent(
                free_name(id_of(name), taken), f"what publishes the topics of {one_line(name)}",
                rates=rates,
            )  # fmt: skip

    def _recorded(self, topic: GraphTopic) -> RecordedTopic:
        heard = self.heard.get(topic.name)
        if heard is None or not heard.count:
            what = "nothing was sent" if topic.publishers else "nobody published it"
            return RecordedTopic(topic.name, self.types[topic.name], what)
        size = byte_text(heard.mean_bytes)
        if heard.rate is None:
            what = "latched" if heard.latched else f"{heard.count} in {self.seen.seconds:g} s"
            return RecordedTopic(topic.name, self.types[topic.name], f"{what}, {size} each")
        flow = heard.rate.mean_hz * heard.mean_bytes
        is_big = flow > _BIG_BYTES_S
        what = f"{heard.rate.mean_hz:.3g} Hz, {size} each"
        what += f": {byte_text(flow)} a second" if is_big else ""
        return RecordedTopic(topic.name, self.types[topic.name], what, is_big)


_SPECIAL = re.compile(r"[.^$*+?{}\[\]\\|()]")


def escaped(text: str) -> str:
    """Return a regular expression that finds a text; blanks stay readable."""
    return _SPECIAL.sub(r"\\\g<0>", text)


def _is_common(name: str) -> bool:
    return bool(_COMMON.search(name)) or name.endswith(_COMMON_ENDS)


def _reaches(needs: Mapping[str, Collection[str]], start: str, goal: str) -> bool:
    """Return whether a node needs another one, directly or through others."""
    waiting, seen = [start], set[str]()
    while waiting:
        node = waiting.pop()
        if node == goal:
            return True
        if node not in seen:
            seen.add(node)
            waiting += needs.get(node, ())
    return False


def _ids(nodes: Sequence[str]) -> dict[str, str]:
    """Return an id for each node, made of its whole name."""
    taken: set[str] = set()
    return {node: free_name(id_of(node), taken) for node in nodes}


def id_of(name: str) -> str:
    """Make the id of a component of any name."""
    return derive_id(
        readable_identifier(name.strip("/").replace("/", "_")).lower().strip("_") or name
    )


def free_name(name: str, taken: set[str]) -> str:
    """Return a name that is not taken yet, and take it."""
    free, number = name, 2
    while free in taken:
        free, number = f"{name[:58]}_{number}", number + 1
    taken.add(free)
    return free


def _some(names: Sequence[str], most: int = 8) -> str:
    shown = ", ".join(one_line(name) for name in names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def byte_text(count: float) -> str:
    """Return a number of bytes for people."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} GB"
