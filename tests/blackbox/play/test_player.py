"""The pace of what is played: its schedule, what is late, the clock, and what is left out."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import pytest

from amberbox.blackbox.play.player import Player, PlayReport, RenamedMessages, is_command
from amberbox.blackbox.query.foxglove import ViewerMessage
from amberbox.core.clock import NS
from amberbox.core.types import Schema, Topic

POSE = Topic("pose", "json")
MAP = Topic("/map", "ros1", Schema("std_msgs/String", "ros1msg", b"string data\n"), latched=True)
T0_NS = 1_700_000_000 * NS
SPAN = (T0_NS, T0_NS + 10 * NS)


@dataclass
class Messages:
    """A pose every second, and a map from before."""

    topics: Sequence[Topic] = (POSE, MAP)

    def latched(self, at_ns: int) -> Sequence[ViewerMessage]:
        return [ViewerMessage(MAP, at_ns, b"map")]

    def read(self, from_ns: int) -> Iterator[ViewerMessage]:
        return (ViewerMessage(POSE, from_ns + n * NS, b"%d" % n) for n in range(11))


@dataclass
class Stop(threading.Event):
    """A clock that is moved by waiting for it; sets itself at ``end_s``."""

    now_s: float = 100.0
    end_s: float = 1e9

    def __post_init__(self) -> None:
        super().__init__()

    def wait(self, timeout: float | None = None) -> bool:
        self.now_s += timeout or 0.0
        if self.now_s >= self.end_s:
            self.set()
        return self.is_set()


@dataclass
class Target:
    """Notes what is sent, and when; each message takes ``takes_s``."""

    stop: Stop
    takes_s: float = 0.0
    sent: list[tuple[float, str, bytes, bool]] = field(default_factory=list)
    times: list[int] = field(default_factory=list)
    is_closed: bool = False

    def refused(self, topic: Topic) -> str:
        return ""

    def open(self, topics: Sequence[Topic]) -> None:
        pass

    def is_heard(self) -> bool:
        return True

    def send(self, topic: Topic, data: bytes, *, patient: bool) -> int:
        self.sent.append((round(self.stop.now_s - 100.0, 6), topic.name, data, patient))
        self.stop.now_s += self.takes_s
        return int(topic is POSE)

    def set_clock(self, at_ns: int) -> None:
        self.times.append(at_ns)

    def dropped(self) -> int:
        return 3

    def close(self) -> None:
        self.is_closed = True


def played(
    speed: float | None, *, takes_s: float = 0.0, end_s: float = 1e9, loop: bool = False
) -> tuple[Target, PlayReport]:
    stop = Stop(end_s=end_s)
    target = Target(stop, takes_s)
    topics = frozenset({POSE, MAP})
    player = Player(
        Messages(), SPAN, target, topics, speed, loop=loop, clock_s=lambda: stop.now_s
    )  # fmt: skip
    player.run(stop)
    assert target.is_closed
    return target, player.report


def test_messages_are_sent_when_they_are_due() -> None:
    target, report = played(2.0)
    assert target.sent[0] == (0.0, "/map", b"map", False)
    assert target.sent[1:] == [(n / 2, "pose", b"%d" % n, False) for n in range(11)]
    assert (report.counts, report.late, report.dropped) == ({"/map": 1, "pose": 11}, 0, 3)
    assert (report.unheard, report.duration_s) == (1, 5.0)
    assert report.lines()[0] == "played 12 messages of 2 topics in 5.0 s"


def test_delays_do_not_add_up_and_are_counted() -> None:
    target, report = played(1.0, takes_s=0.3)
    assert [at_s for at_s, name, *_ in target.sent if name == "pose"][1:] == list(range(1, 11))
    assert report.late == 1  # the first pose, which waited for the map
    assert report.latest_s == pytest.approx(0.3)


def test_without_speed_nothing_is_waited_for_but_subscribers() -> None:
    target, report = played(None)
    assert all(at_s == 0.0 and patient for at_s, _, _, patient in target.sent)
    assert report.late == 0


def test_the_clock_goes_on_between_messages() -> None:
    target, _ = played(1.0)
    assert target.times == sorted(target.times)
    assert len(target.times) == pytest.approx(1000, abs=5)  # 100 Hz for 10 s
    assert SPAN[0] == target.times[0] and SPAN[1] - target.times[-1] <= NS // 50


def test_the_clock_ends_with_the_last_message_however_fast() -> None:
    target, _ = played(None)
    assert target.times == list(SPAN)


def test_stop_ends_at_once_also_in_a_loop() -> None:
    target, _ = played(1.0, end_s=102.5)
    assert [data for _, name, data, _ in target.sent if name == "pose"] == [b"0", b"1", b"2"]
    target, report = played(1.0, end_s=125.5, loop=True)
    assert report.counts == {"/map": 3, "pose": 11 + 11 + 6}


def test_topics_get_a_prefix() -> None:
    renamed = RenamedMessages(Messages(), "/replay/")
    assert [topic.name for topic in renamed.topics] == ["/replay/pose", "/replay/map"]
    assert renamed.latched(T0_NS)[0].topic == renamed.topics[1]
    assert next(renamed.read(T0_NS)) == (renamed.topics[0], T0_NS, b"0")


def of_type(name: str, kind: str) -> Topic:
    return Topic(name, "ros1", Schema(kind, "ros1msg", b""))


@pytest.mark.parametrize(
    ("topic", "expected"),
    [
        (of_type("/base", "geometry_msgs/Twist"), True),
        (of_type("/base", "geometry_msgs/msg/TwistStamped"), True),
        (of_type("/move_base/goal", "move_base_msgs/MoveBaseActionGoal"), True),
        (of_type("/arm", "trajectory_msgs/JointTrajectory"), True),
        (of_type("/lights", "robot_msgs/LightCmd"), True),
        (of_type("/robot/cmd_vel", "robot_msgs/Speed"), True),
        (Topic("gripper_command", "json"), True),
        (of_type("/odom", "nav_msgs/Odometry"), False),
        (of_type("/move_base/result", "move_base_msgs/MoveBaseActionResult"), False),
        (of_type("/commander_state", "std_msgs/String"), False),
    ],
)
def test_commands_are_recognised(topic: Topic, expected: bool) -> None:
    assert is_command(topic) is expected
