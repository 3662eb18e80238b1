"""State flow: the states a robot goes through, how it gets from one to the next, how long it stays.

After Li and Parker (IROS 2007, 2008, AAAI 2009): features of all variables, principal components,
soft clusters as states, transition probabilities that depend on the time in a state. What is in no
known state is a hard fault, an improbable transition or stay a logic fault, an improbable
combination of the states of several robots a team fault. States may also be given as events, as in
software (Elbaum and Munson 2000); their decoder is the list of the last transitions of an alarm.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from amberbox.core.clock import NS
from amberbox.core.config import Finding
from amberbox.core.contracts import LearntState, MissionRows, Row, Score, ScoreReason
from amberbox.core.errors import AmberboxError
from amberbox.core.options import option
from amberbox.detection.channels import (
    CLIP,
    Channels,
    Floats,
    Sample,
    add_count,
    as_floats,
    as_number,
    center_and_spread,
    learn_channels,
)
from amberbox.detection.clusters import Clusters, learn_clusters
from amberbox.detection.features import NAMES, Window
from amberbox.detection.learnt_options import (
    only_value_errors,
    options_from_json,
    options_to_json,
)
from amberbox.detection.transitions import Transitions

ROBOT = "robot"
TEAM = "team"
_SHORTEST_S, _LONGEST_S = 0.05, 30.0
_MESSAGES, _USUAL_S, _PARTS = 20, 1.0, 3
_MOST_VECTORS = 4000
_MOST_STEPS = 10_000  # at once, after a leap of time
_MOST_EVENTS = 100
_MOST_JOINT = 2000
_LONGEST_TEXT = 80
_LISTED = 5
_KEPT_TRANSITIONS = 8
_FAR = 1.25  # times the 99 % quantile of nominal distances: such a state is unknown
_DECAY = 0.7  # of the surprise of a stay, per step
_LEAST_PROBABILITY = 1e-12
_INDEPENDENT = 2.0  # how much independence of the members weighs, in steps


@dataclass(frozen=True, slots=True)
class StateFlowOptions:
    """Where states come from."""

    variables: Sequence[str] = option(
        (), "those that make the robot's state: ITEM.VARIABLE; all if empty"
    )
    members: Mapping[str, Sequence[str]] = option(
        {}, "the variables of each robot of a team, or part of one; * for any"
    )
    events: Sequence[str] = option(
        (), "variables whose values are states themselves, ITEM.VARIABLE"
    )
    clusters: bool = option(True, "learn states from numbers; without it only from events")
    window: float | None = option(
        None, "how long the features of a state look back; learnt by default", unit="s"
    )
    step: float | None = option(
        None, "how often the state is determined; twice in a window by default", unit="s"
    )
    states: int = option(12, "the most states of a member")
    explained: float = option(0.95, "share of the variance that the principal components keep")
    smoothing: float = option(0.3, "weight of the newest step in distances and transitions")
    event_smoothing: float = option(0.05, "weight of the newest event in the score of transitions")

    def check(self) -> Iterator[Finding]:
        """Refuse values outside their ranges."""
        for key in ("window", "step"):
            value = getattr(self, key)
            if value is not None and not 0.01 <= value <= 3600:
                yield key, "must lie between 10 ms and 1 h"
        if not 1 <= self.states <= 100:
            yield "states", "must lie between 1 and 100"
        if not 0 < self.explained <= 1:
            yield "explained", "must lie above 0, and be 1 at most"
        for key in ("smoothing", "event_smoothing"):
            if not 0 < getattr(self, key) <= 1:
                yield key, "must lie above 0, and be 1 at most"
        if self.members and self.variables:
            yield "variables", "list them by member, or as those of the robot, not both"
        if not (self.clusters or self.events):
            yield "events", "list at least one variable, or learn states from numbers"
        if {ROBOT, TEAM} & set(self.members):
            yield "members", f"'{ROBOT}' and '{TEAM}' are names of the detector's own"


Config = StateFlowOptions
SAMPLE = """\
window: 1 s
events: [controller.mode]
"""


class Detector:
    """Scores each member's distance from all states, its transitions and stays; and the team."""

    version = 1

    def __init__(self, config: StateFlowOptions) -> None:
        self.config = config
        self.counts: dict[str, int] = {}
        self._used = config  # with a window and a step
        self._set_up([])

    def _set_up(self, members: Sequence[_Member]) -> None:
        self._members = {member.name: member for member in members}
        self._events = {
            (member.item, member.variable): member
            for member in members
            if isinstance(member, _EventMember)
        }
        self._joint: dict[tuple[int, ...], float] = {}
        self._joint_steps = 0.0
        self.begin(0)

    def fit(self, missions: Sequence[MissionRows]) -> None:
        """Learn the states of each member, then the transitions between them and the team."""
        config = self._used = _with_window(self.config, missions)
        self._set_up([])
        members: list[_Member] = [
            _EventMember.learn(address, missions, config) for address in config.events
        ]
        if config.clusters:
            groups = config.members or {ROBOT: config.variables}
            members += [
                _ClusterMember.learn(name, wanted, missions, config, self.counts)
                for name, wanted in groups.items()
            ]
        self._set_up(members)
        for mission in missions:
            self.begin(mission.span[0])
            for row in mission:
                self._feed(row, learning=True)
            self._advance(mission.span[1], learning=True)
            for member in members:
                member.flow.end_of_learning(mission.span[1])
        self.begin(0)

    def begin(self, at_ns: int) -> None:
        """Forget the messages before a mission."""
        self._step_ns = round((self._used.step or _SHORTEST_S) * NS)
        self._next_ns = at_ns + self._step_ns
        self._team_score: float | None = None
        self._last_joint: tuple[int, ...] = ()
        self._now_ns = at_ns
        for member in self._members.values():
            member.begin()

    def observe(self, row: Row) -> Sequence[Score]:
        """Return the scores of the steps before a message, and of an event in it."""
        return self._feed(row, learning=False)

    def tick(self, now_ns: int) -> Sequence[Score]:
        """Return the scores of the steps before a time."""
        return self._advance(now_ns, learning=False)

    def _feed(self, row: Row, learning: bool) -> list[Score]:
        scores = self._advance(row.at_ns, learning)
        counts = {} if learning else self.counts
        for (item, _), event in self._events.items():
            if item == row.item:
                scores += event.observe(row, learning, counts)
        for member in self._members.values():
            if isinstance(member, _ClusterMember):
                member.window.add(row, counts)
        return scores

    def _advance(self, now_ns: int, learning: bool) -> list[Score]:
        """Determine the states at all steps until ``now_ns``."""
        scores: list[Score] = []
        self._next_ns = max(self._next_ns, now_ns - _MOST_STEPS * self._step_ns)
        while self._next_ns <= now_ns:
            at_ns = self._now_ns = self._next_ns
            found = [list(member.step(at_ns, learning)) for member in self._members.values()]
            scores += [score for part in found for score in part]
            scores += self._team(at_ns, learning)
            self._next_ns += self._step_ns
            if not any(member.is_alive for member in self._members.values()):
                skipped = (now_ns - self._next_ns) // self._step_ns
                self._next_ns += max(skipped, 0) * self._step_ns
        return scores

    def _team(self, at_ns: int, learning: bool) -> list[Score]:
        """Return the score of the members' joint state, if there are several."""
        members = list(self._members.values())
        if len(members) < 2 or not all(m.is_alive and m.flow.state is not None for m in members):
            return []
        joint = tuple(int(m.flow.state or 0) for m in members)
        if learning:
            if joint in self._joint or len(self._joint) < _MOST_JOINT:
                self._joint[joint] = self._joint.get(joint, 0.0) + 1
            self._joint_steps += 1
            return []
        alone = math.prod(m.flow.share_of(state) for m, state in zip(members, joint, strict=True))
        count = self._joint.get(joint, 0.0)
        likely = (count + _INDEPENDENT * alone) / (self._joint_steps + _INDEPENDENT)
        # how much less probable than if the members had nothing to do with each other
        surprise = max(math.log(alone / likely), 0.0)
        weight = self._used.smoothing
        before = self._team_score or 0.0
        self._team_score = before + weight * (surprise - before)
        self._last_joint = joint
        return [Score(at_ns, TEAM, self._team_score)]

    def explain(self, series: str) -> ScoreReason:
        """Return the variables that are far, or the last transitions with their probabilities."""
        if series == TEAM:
            joint = zip(self._members.values(), self._last_joint, strict=True)
            states = ", ".join(f"{member.name}: {member.label(state)}" for member, state in joint)
            return ScoreReason("team", TEAM, "", f"this combination is improbable: {states}")
        name, _, finding = series.rpartition(" ")
        return self._members[name].explain(finding, self._now_ns)

    def learnt(self) -> LearntState:
        """Return the states and transitions of each member, and the team's joint states."""
        values: dict[str, Any] = {"options": options_to_json(self._used), "members": []}
        values["steps"] = self._joint_steps
        arrays: dict[str, NDArray[Any]] = {}
        for number, member in enumerate(self._members.values()):
            own, parts = member.learnt()
            values["members"].append({"name": member.name, **own})
            arrays |= {f"{number}_{key}": array for key, array in parts.items()}
        values["joint"] = [[list(joint), count] for joint, count in sorted(self._joint.items())]
        return LearntState(values, arrays)

    @only_value_errors()
    def restore(self, state: LearntState) -> None:
        """Restore what was learnt."""
        self._used = options_from_json(Config, state.values["options"])
        members: list[_Member] = []
        for number, values in enumerate(state.values["members"]):
            prefix = f"{number}_"
            own = {k[len(prefix) :]: v for k, v in state.arrays.items() if k.startswith(prefix)}
            kind = _EventMember if "events" in values else _ClusterMember
            members.append(kind.restored(values, own, self._used))
        self._set_up(members)
        self._joint_steps = as_number(state.values["steps"], 0.0)
        for joint, count in state.values["joint"]:
            self._joint[tuple(map(int, joint))] = as_number(count, 0.0)

    def snapshot(self) -> dict[str, Any]:
        """Return the messages in windows and the states reached."""
        return {
            "next_ns": self._next_ns,
            "now_ns": self._now_ns,
            "team": self._team_score,
            "joint": list(self._last_joint),
            "members": [member.snapshot() for member in self._members.values()],
        }

    @only_value_errors()
    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Continue a mission."""
        self._next_ns, self._now_ns = int(snapshot["next_ns"]), int(snapshot["now_ns"])
        team = snapshot["team"]
        self._team_score = None if team is None else as_number(team, 0.0)
        self._last_joint = tuple(map(int, snapshot["joint"]))
        for member, state in zip(self._members.values(), snapshot["members"], strict=True):
            member.resume(state)


class _Flow:
    """The way of one member through its states: transitions, stays, and their scores."""

    def __init__(self, size: int, smoothing: float) -> None:
        self.size, self._smoothing = size, smoothing
        self.transitions = Transitions(size)
        self.visits = np.zeros(size + 1)
        self.begin()

    def begin(self) -> None:
        """Start a mission in no state."""
        self.state: int | None = None
        self.since_ns = 0
        self._soft: Floats | None = None
        self._cut_off = True  # the stay began before it was seen
        self.surprise = 0.0
        self.stay = 0.0
        self.history: list[tuple[int, int, int, float, float]] = []

    def lose(self) -> None:
        """Forget the state: nothing is known for a while."""
        self.state, self._soft = None, None

    def share_of(self, state: int) -> float:
        """Return the share of nominal steps in a state."""
        return float((self.visits[state] + 0.5) / (self.visits.sum() + 0.5 * len(self.visits)))

    def enter(self, at_ns: int, soft: Floats, state: int, learning: bool) -> bool:
        """Go to a soft state whose most probable one is ``state``; return whether it was scored."""
        if self.state is None or self._soft is None:
            self.state, self.since_ns, self._soft, self._cut_off = state, at_ns, soft, True
            if learning:
                self.visits[state] += 1
            return False
        spent_s = (at_ns - self.since_ns) / NS
        if learning:
            self.visits[state] += 1
            self.transitions.learn(self._soft, soft, spent_s)
            if state != self.state:
                self.transitions.learn_stay(self.state, spent_s, complete=not self._cut_off)
        else:
            self._score(at_ns, soft, state, spent_s)
        if state != self.state:
            self.state, self.since_ns, self._cut_off = state, at_ns, False
        self._soft = soft
        return True

    def _score(self, at_ns: int, soft: Floats, state: int, spent_s: float) -> None:
        assert self.state is not None and self._soft is not None
        likely = self.transitions.probability(self._soft, soft, spent_s)
        likely = max(likely, _LEAST_PROBABILITY)
        self.surprise += self._smoothing * (max(-math.log(likely), 0.0) - self.surprise)
        stay = self.transitions.surprise_of_staying(self.state, spent_s)
        if state != self.state:
            if not self._cut_off:
                stay = max(stay, self.transitions.surprise_of_leaving(self.state, spent_s))
            self.history.append((at_ns, self.state, state, likely, spent_s))
            del self.history[:-_KEPT_TRANSITIONS]
        self.stay = max(stay, _DECAY * self.stay)

    def end_of_learning(self, at_ns: int) -> None:
        """Count the stay that the end of a mission cuts off."""
        if self.state is not None:
            spent_s = max(at_ns - self.since_ns, 0) / NS
            self.transitions.learn_stay(self.state, spent_s, complete=False)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what was learnt."""
        return {**self.transitions.arrays(), "visits": self.visits}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Restore what was learnt."""
        self.transitions = Transitions.restored(arrays, self.size)
        self.visits = as_floats(arrays["visits"], self.visits.shape)

    def snapshot(self) -> dict[str, Any]:
        """Return the state and its scores, as JSON."""
        return {
            "state": self.state,
            "since_ns": self.since_ns,
            "soft": None if self._soft is None else self._soft.tolist(),
            "cut_off": self._cut_off,
            "surprise": self.surprise,
            "stay": self.stay,
            "history": [list(entry) for entry in self.history],
        }

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Restore what ``snapshot`` returned."""
        state, soft = snapshot["state"], snapshot["soft"]
        self.state = None if state is None else _place(state, self.size + 1)
        self.since_ns, self._cut_off = int(snapshot["since_ns"]), bool(snapshot["cut_off"])
        self._soft = None if soft is None else as_floats(np.array(soft), (self.size + 1,))
        self.surprise = as_number(snapshot["surprise"], 0.0)
        self.stay = as_number(snapshot["stay"], 0.0)
        self.history = [
            (
                int(at),
                _place(old, self.size + 1),
                _place(new, self.size + 1),
                as_number(p),
                as_number(s),
            )
            for at, old, new, p, s in snapshot["history"]
        ]


class _Member(Protocol):
    name: str
    flow: _Flow

    @property
    def is_alive(self) -> bool: ...
    def begin(self) -> None: ...
    def step(self, at_ns: int, learning: bool) -> Sequence[Score]: ...
    def label(self, state: int) -> str: ...
    def explain(self, finding: str, now_ns: int) -> ScoreReason: ...
    def learnt(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]: ...
    def snapshot(self) -> dict[str, Any]: ...
    def resume(self, snapshot: Mapping[str, Any]) -> None: ...


def _decoded(member: _Member, now_ns: int) -> tuple[str, ...]:
    """Return the last transitions of a member, with their probabilities, the newest last."""
    return tuple(
        f"{(at_ns - now_ns) / NS:.4g} s: {member.label(old)} -> {member.label(new)}, "
        f"probability {likely:.2g}, after {spent_s:.3g} s"
        for at_ns, old, new, likely, spent_s in member.flow.history
    )


def _flow_reason(
    member: _Member, finding: str, now_ns: int, item: str, variable: str
) -> ScoreReason:
    flow = member.flow
    last = _decoded(member, now_ns)
    label = member.label(flow.state) if flow.state is not None else "no state"
    if finding == "stay":
        spent_s = (now_ns - flow.since_ns) / NS
        text = f"{member.name}: a stay of improbable length; in {label} for {spent_s:.3g} s"
    else:
        text = f"{member.name}: improbable transitions; now in {label}"
    return ScoreReason(finding, item, variable, text, transitions=last)


class _ClusterMember:
    """A member whose states are clusters of the features of its variables."""

    def __init__(self, name: str, channels: Channels, config: StateFlowOptions) -> None:
        self.name, self.channels, self._config = name, channels, config
        self.longest_ns = dict.fromkeys(channels.items, 0)
        size = len(channels) * len(NAMES)
        self.center, self.spread = np.zeros(size), np.ones(size)
        self.farthest = 0.0
        self.clusters: Clusters | None = None
        self.begin()

    @classmethod
    def learn(
        cls,
        name: str,
        wanted: Sequence[str],
        missions: Sequence[MissionRows],
        config: StateFlowOptions,
        counts: dict[str, int],
    ) -> _ClusterMember:
        """Learn the states of nominal missions; raises AmberboxError if they are too short."""
        member = cls(name, learn_channels(missions, counts, wanted), config)
        vectors = member._vectors(missions, counts)
        if len(vectors) < 2:
            raise AmberboxError(
                f"the nominal missions are too short for windows of {config.window or 0:g} s",
                "give longer missions, or set a shorter 'window' and 'step'",
            )
        found = np.array(vectors)
        scales = np.array([center_and_spread(column) for column in found.T])
        member.center = scales[:, 0].copy()
        member.spread = np.maximum(scales[:, 1], np.repeat(member.channels.fine, len(NAMES)))
        scaled = np.array([member._scaled(vector) for vector in vectors])
        member._use(learn_clusters(scaled, config.states, config.explained))
        assert member.clusters is not None
        distances = [member.clusters.locate(vector)[1] for vector in scaled]
        member.farthest = _FAR * float(np.quantile(distances, 0.99))
        return member

    def _vectors(self, missions: Sequence[MissionRows], counts: dict[str, int]) -> list[Floats]:
        """Return the features of some steps, evenly over all missions; learn the longest gaps."""
        sample: Sample[Floats] = Sample(_MOST_VECTORS)
        step_ns = round((self._config.step or _SHORTEST_S) * NS)
        for mission in missions:
            self.begin()
            next_ns = mission.span[0] + step_ns
            last_ns: dict[str, int] = {}
            for row in chain(mission, (None,)):
                at_ns = mission.span[1] if row is None else row.at_ns
                while next_ns <= at_ns:
                    vector = self.window.features(next_ns)
                    if vector is None:  # nothing until the next message
                        next_ns += (at_ns - next_ns) // step_ns * step_ns
                    else:
                        sample.add(vector)
                    next_ns += step_ns
                if row is not None and row.item in self.longest_ns:
                    gap_ns = at_ns - last_ns.get(row.item, at_ns)
                    self.longest_ns[row.item] = max(self.longest_ns[row.item], gap_ns)
                    last_ns[row.item] = at_ns
                    self.window.add(row, counts)
        return sample.values

    def _use(self, clusters: Clusters) -> None:
        self.clusters = clusters
        self.flow = _Flow(len(clusters), self._config.smoothing)
        self._labels = [self._name_of(k) for k in range(len(clusters))]
        self.begin()

    def _name_of(self, number: int) -> str:
        """Return a name of a state: its number, and the variables that are unusual in it."""
        assert self.clusters is not None
        means = self.clusters.center + self.clusters.means[number] @ self.clusters.directions
        level = means.reshape(-1, len(NAMES))[:, 0]
        order = np.argsort(-np.abs(level), kind="stable")[:2]
        words = [
            f"{'.'.join(self.channels.names[i])} {'high' if level[i] > 0 else 'low'}"
            for i in order
            if abs(level[i]) > 0.5
        ]
        return f"state {number + 1}" + (f" ({', '.join(words)})" if words else "")

    def _scaled(self, vector: Floats) -> Floats:
        return np.minimum(np.maximum((vector - self.center) / self.spread, -CLIP), CLIP)

    def begin(self) -> None:
        """Forget all messages."""
        window_ns = round((self._config.window or _SHORTEST_S) * NS)
        self.window = Window(self.channels, window_ns, self.longest_ns)
        self.is_alive = False
        self._vector: Floats | None = None
        self._distance: float | None = None
        if self.clusters is None:
            self.flow = _Flow(0, self._config.smoothing)
        self.flow.begin()

    def step(self, at_ns: int, learning: bool) -> Sequence[Score]:
        """Determine the state."""
        vector = self.window.features(at_ns)
        self.is_alive = vector is not None
        if vector is None or self.clusters is None:
            self.flow.lose()
            return ()
        self._vector = self._scaled(vector)
        shares, distance = self.clusters.locate(self._vector)
        is_known = distance <= self.farthest
        weight = self._config.smoothing
        before = distance if self._distance is None else self._distance
        self._distance = before + weight * (distance - before)
        state = int(np.argmax(shares)) if is_known else self.flow.size
        soft = np.zeros(self.flow.size + 1)
        if is_known:
            soft[:-1] = shares
        else:
            soft[-1] = 1.0
        scores = [Score(at_ns, f"{self.name} unknown_state", self._distance)]
        if self.flow.enter(at_ns, soft, state, learning):
            scores.append(Score(at_ns, f"{self.name} transition", self.flow.surprise))
            scores.append(Score(at_ns, f"{self.name} stay", self.flow.stay))
        return scores

    def label(self, state: int) -> str:
        """Return the name of a state."""
        return self._labels[state] if state < self.flow.size else "unknown state"

    def explain(self, finding: str, now_ns: int) -> ScoreReason:
        """Return the variables that are far from the nearest state, or the last transitions."""
        if finding != "unknown_state" or self.clusters is None or self._vector is None:
            return _flow_reason(self, finding, now_ns, self.name, "")
        parts = self.clusters.contributions(self._vector).reshape(-1, len(NAMES))
        total = float(parts.sum()) or 1.0
        sums = parts.sum(axis=1)
        order = np.argsort(-sums, kind="stable")[:_LISTED]
        shares = tuple((".".join(self.channels.names[i]), float(sums[i]) / total) for i in order)
        item, variable = self.channels.names[order[0]]
        feature = NAMES[int(np.argmax(parts[order[0]]))]
        text = f"{self.name} is in no known state: the {feature} of {item}.{variable}"
        last = _decoded(self, now_ns)
        return ScoreReason("unknown_state", item, variable, text, shares, transitions=last)

    def learnt(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return what was learnt."""
        assert self.clusters is not None
        names, arrays = self.channels.learnt()
        scales = {"feature_center": self.center, "feature_spread": self.spread}
        arrays |= {**scales, **self.flow.arrays()}
        arrays |= {f"clusters_{key}": array for key, array in self.clusters.arrays().items()}
        values = {"channels": names, "longest_ns": self.longest_ns, "farthest": self.farthest}
        return values, arrays

    @classmethod
    def restored(
        cls, values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], config: StateFlowOptions
    ) -> _ClusterMember:
        """Make the member that ``learnt`` returned."""
        member = cls(str(values["name"]), Channels.restored(values["channels"], arrays), config)
        gaps = {str(item): int(gap) for item, gap in values["longest_ns"].items()}
        member.longest_ns = {item: gaps[item] for item in member.longest_ns}
        size = len(member.center)
        member.center = as_floats(arrays["feature_center"], (size,))
        member.spread = as_floats(arrays["feature_spread"], (size,))
        if not (member.spread > 0).all():
            raise ValueError("a spread that is not above 0")
        own = {
            k.removeprefix("clusters_"): v for k, v in arrays.items() if k.startswith("clusters_")
        }
        member._use(Clusters.restored(own, size))
        member.flow.restore(arrays)
        member.farthest = as_number(values["farthest"], 0.0)
        member.begin()
        return member

    def snapshot(self) -> dict[str, Any]:
        """Return the messages of the window and the state."""
        return {
            "window": self.window.snapshot(),
            "alive": self.is_alive,
            "distance": self._distance,
            "vector": None if self._vector is None else self._vector.tolist(),
            "flow": self.flow.snapshot(),
        }

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Continue a mission."""
        self.begin()
        self.window.resume(snapshot["window"])
        self.is_alive = bool(snapshot["alive"])
        distance, vector = snapshot["distance"], snapshot["vector"]
        self._distance = None if distance is None else as_number(distance, 0.0)
        self._vector = None if vector is None else as_floats(np.array(vector), self.center.shape)
        self.flow.resume(snapshot["flow"])


class _EventMember:
    """A member whose state is the value of a variable; each message is a transition."""

    def __init__(
        self, item: str, variable: str, events: Sequence[str], config: StateFlowOptions
    ) -> None:
        self.item, self.variable, self.name = item, variable, f"{item}.{variable}"
        self._events = {text: number for number, text in enumerate(events)}
        self._texts = [*events, "unknown"]
        self.flow = _Flow(len(events), config.event_smoothing)
        self.is_alive = False

    @classmethod
    def learn(
        cls, address: str, missions: Sequence[MissionRows], config: StateFlowOptions
    ) -> _EventMember:
        """Learn which values there are; raises AmberboxError if there is none."""
        seen: dict[str, int] = {}
        name: tuple[str, str] | None = None
        for row in (row for mission in missions for row in mission):
            if address.startswith(f"{row.item}."):
                variable = address[len(row.item) + 1 :]
                event = _event_of(row, variable)
                if event is not None:
                    name = row.item, variable
                    seen[event] = seen.get(event, 0) + 1
        if name is None:
            raise AmberboxError(
                f"the nominal missions have no values of '{address}'",
                "write events as ITEM.VARIABLE, as 'amberbox query' lists them",
            )
        events = sorted(sorted(seen, key=lambda event: (-seen[event], event))[:_MOST_EVENTS])
        return cls(*name, events, config)

    def begin(self) -> None:
        """Forget all messages."""
        self.is_alive = False
        self.flow.begin()

    def observe(self, row: Row, learning: bool, counts: dict[str, int]) -> Sequence[Score]:
        """Use the event in a message."""
        event = _event_of(row, self.variable)
        if event is None:
            add_count(counts, "messages without an event")
            return ()
        state = self._events.get(event, self.flow.size)
        if state == self.flow.size:
            add_count(counts, "events that were not learnt")
        self.is_alive = True
        soft = np.zeros(self.flow.size + 1)
        soft[state] = 1.0
        if not self.flow.enter(row.at_ns, soft, state, learning):
            return ()
        return [Score(row.at_ns, f"{self.name} transition", self.flow.surprise)]

    def step(self, at_ns: int, learning: bool) -> Sequence[Score]:
        """Judge how long the last event is ago."""
        flow = self.flow
        if flow.state is None or learning:
            return ()
        spent_s = (at_ns - flow.since_ns) / NS
        stay = flow.transitions.surprise_of_staying(flow.state, spent_s)
        flow.stay = max(stay, _DECAY * flow.stay)
        return [Score(at_ns, f"{self.name} stay", flow.stay)]

    def label(self, state: int) -> str:
        """Return the text of an event."""
        return self._texts[state]

    def explain(self, finding: str, now_ns: int) -> ScoreReason:
        """Return the last transitions."""
        return _flow_reason(self, finding, now_ns, self.item, self.variable)

    def learnt(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return what was learnt."""
        values = {"item": self.item, "variable": self.variable, "events": self._texts[:-1]}
        return values, self.flow.arrays()

    @classmethod
    def restored(
        cls, values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], config: StateFlowOptions
    ) -> _EventMember:
        """Make the member that ``learnt`` returned."""
        events = [str(event) for event in values["events"]]
        member = cls(str(values["item"]), str(values["variable"]), events, config)
        member.flow.restore(arrays)
        return member

    def snapshot(self) -> dict[str, Any]:
        """Return the state."""
        return {"alive": self.is_alive, "flow": self.flow.snapshot()}

    def resume(self, snapshot: Mapping[str, Any]) -> None:
        """Continue a mission."""
        self.is_alive = bool(snapshot["alive"])
        self.flow.resume(snapshot["flow"])


def _event_of(row: Row, variable: str) -> str | None:
    """Return the event in a message: a text, or a number as text."""
    text = row.texts.get(variable)
    if text is not None:
        return text[:_LONGEST_TEXT]
    value = row.values.get(variable, math.nan)
    return f"{value:g}" if math.isfinite(value) else None


def _place(value: Any, count: int) -> int:
    """Return a learnt index; raises ValueError if it is not one of so many."""
    place = int(value)
    if not 0 <= place < count:
        raise ValueError(f"there is no state {place}")
    return place


def _with_window(config: StateFlowOptions, missions: Sequence[MissionRows]) -> StateFlowOptions:
    """Return the options with a window and a step.

    A window holds 20 messages of the most frequent item and is a second long at least, but no
    longer than a third of a usual mission.
    """
    window_s = config.window
    if window_s is None:
        counts: dict[str, int] = {}
        for row in (row for mission in missions for row in mission):
            counts[row.item] = counts.get(row.item, 0) + 1
        spans = sorted((mission.span[1] - mission.span[0]) / NS for mission in missions)
        gap_s = sum(spans) / max(counts.values(), default=1)
        window_s = max(_MESSAGES * gap_s, _USUAL_S)
        window_s = min(window_s, _LONGEST_S, spans[len(spans) // 2] / _PARTS if spans else 1.0)
        window_s = max(window_s, _SHORTEST_S)
    return replace(config, window=window_s, step=config.step or max(window_s / 2, _SHORTEST_S))
