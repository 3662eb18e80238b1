"""Missions: by rule, by hand, over several runs, detected in old recordings, used in queries."""

from __future__ import annotations

import random
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any, Literal

import msgspec
import pytest

from amberbox.blackbox.journal.tail import JournalHead, read_head
from amberbox.blackbox.query.mission_search import detect
from amberbox.blackbox.query.record import LocalRecord
from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention import live_reader
from amberbox.blackbox.retention.maintenance import RetentionService
from amberbox.blackbox.retention.missions import (
    MissionInstant,
    MissionService,
    RecordedMission,
    choose,
    end,
    id_of,
    load,
    missions_named,
    start,
)
from amberbox.blackbox.robot_folder.robot_yaml import MissionRule, RetentionOptions
from amberbox.blackbox.store.derived_journal import DerivedJournal
from amberbox.blackbox.store.store import WriterLock, create_store, open_store, submit
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.source import TopicOptions
from amberbox.core.types import Topic
from amberbox.testing.clock import ManualClock
from tests.support.manual_recorder import ManualBox

TASK = Topic("/task", "json")
OTHER = Topic("/other", "json")
RULE = MissionRule(
    "transport", "ros_task.state == 'STARTED'", "ros_task.state != 'STARTED'",
    failed="ros_task.state == 'FAILED'", outcome="ros_task.state",
    parameters={"goal": "ros_task.goal"},
)  # fmt: skip
BOOT = "0000000a-0000-4000-8000-000000000000"


def clock(**values: Any) -> ManualClock:
    return ManualClock(boot_name=BOOT, **values)


@dataclass
class Robot:
    """A robot that publishes its task once a second, its recorder and its keeper."""

    store: Path
    rules: Sequence[MissionRule] = (RULE,)
    clock: ManualClock = field(default_factory=clock)

    def __post_init__(self) -> None:
        self.box = self._new_box()
        self.keeper = self._new_keeper()

    def tell(self, state: str, times: int = 1, goal: str = "") -> None:
        for _ in range(times):
            data = msgspec.json.encode({"state": state, "goal": goal})
            self.box.hear(TASK, data)
            self.box.write(1.0)
            self.keeper.step()

    def restart(self) -> None:
        """The recorder and its keeper end and begin again; the keeper dies without a word."""
        self.box.close()
        self.box = self._new_box()
        self.keeper = self._new_keeper()

    def close(self) -> None:
        self.box.close()
        self.keeper.step()
        self.keeper.close()

    def _new_box(self) -> ManualBox:
        options = PipelineOptions(boot_id=self.clock.boot_name[:8])
        return ManualBox(self.store, clock=self.clock, options=options)

    def _new_keeper(self) -> MissionService:
        store = open_store(self.store)
        return MissionService(store, self.rules, DerivedJournal(store, "keep", clock=self.clock))

    @property
    def missions(self) -> list[RecordedMission]:
        return load(self.store)


@pytest.fixture
def robot(tmp_path: Path) -> Robot:
    return Robot(tmp_path / "store")


def lasted_s(mission: RecordedMission) -> float:
    assert mission.to_ns is not None
    return (mission.to_ns - mission.from_ns) / NS


def test_messages_begin_and_end_a_mission(robot: Robot) -> None:
    robot.tell("IDLE", 2)
    began_ns = robot.clock.wall
    robot.tell("STARTED", 3, goal="kitchen")
    (mission,) = robot.missions
    assert (mission.name, mission.to_ns) == ("transport", None)
    assert mission.parameters == {"goal": "kitchen"}
    robot.tell("FAILED")
    (mission,) = robot.missions
    assert mission.from_ns == began_ns
    assert (mission.outcome, mission.failed, lasted_s(mission)) == ("FAILED", True, 3.0)
    assert mission.id == id_of("transport", began_ns)


def test_a_start_while_one_lasts_ends_that(robot: Robot) -> None:
    rules = [MissionRule("lap", "ros_task.state == 'LAP'", "ros_task.state == 'STOP'")]
    robot = Robot(robot.store.parent / "other", rules)
    for state in ("LAP", "RUN", "LAP", "STOP", "RUN"):
        robot.tell(state)
    assert [(m.outcome, lasted_s(m)) for m in robot.missions] == [("superseded", 2), ("done", 1)]
    assert not any(m.failed for m in robot.missions)


def test_a_mission_goes_on_over_a_restart(robot: Robot) -> None:
    robot.tell("STARTED", 3)
    robot.restart()
    robot.tell("STARTED", 2)
    assert [m.to_ns for m in robot.missions] == [None]
    robot.tell("DONE")
    assert [(m.outcome, lasted_s(m)) for m in robot.missions] == [("DONE", 5.0)]


def test_nothing_is_told_twice_when_the_keeper_reads_again(robot: Robot) -> None:
    for _ in range(3):
        robot.tell("STARTED", 2)
        robot.tell("DONE", 2)
        robot.keeper = robot._new_keeper()
    robot.close()
    table = LocalRecord(robot.store).query("amberbox_mission", ["state"])
    assert table.values("state") == ["started", "ended"] * 3


def test_a_mission_that_lasts_too_long_times_out(tmp_path: Path) -> None:
    rule = MissionRule("dock", "ros_task.state == 'DOCK'", "ros_task.state == 'OK'", max_s=5.0)
    robot = Robot(tmp_path / "store", [rule])
    robot.tell("DOCK", 9)
    (mission,) = robot.missions
    assert (mission.outcome, mission.failed, lasted_s(mission)) == ("timeout", True, 5.0)


def test_a_mission_times_out_though_the_recorder_always_writes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a busy machine the keeper takes longer to read than the recorder to write again."""
    rule = MissionRule("dock", "ros_task.state == 'DOCK'", "ros_task.state == 'OK'", max_s=5.0)
    robot = Robot(tmp_path / "store", [rule])

    def read_and_write_on(folder: Path) -> JournalHead | None:
        head = read_head(folder)
        if folder == robot.box.pipeline.store.folder("main"):
            robot.box.hear(OTHER, b"{}")
            robot.box.write(0.1)
        return head

    robot.tell("DOCK", 2)
    monkeypatch.setattr(live_reader, "read_head", read_and_write_on)
    robot.tell("DOCK", 9)
    (mission,) = robot.missions
    assert (mission.outcome, lasted_s(mission)) == ("timeout", 5.0)


@pytest.mark.parametrize("restarts", [False, True])
def test_a_mission_times_out_while_nothing_is_recorded(tmp_path: Path, restarts: bool) -> None:
    """The recorder is dead: the keeper uses the clock, and so does the keeper after it."""
    rule = MissionRule("dock", "ros_task.state == 'DOCK'", "ros_task.state == 'OK'", max_s=5.0)
    robot = Robot(tmp_path / "store", [rule])
    robot.tell("DOCK", 2)
    robot.box.close()
    robot.keeper.step()
    if restarts:
        robot.keeper.close()
        robot.keeper = robot._new_keeper()
        robot.keeper.step()
    assert [mission.to_ns for mission in robot.missions] == [None]
    robot.clock.advance(60.0)
    robot.keeper.step()
    (mission,) = robot.missions
    assert (mission.outcome, mission.failed, lasted_s(mission)) == ("timeout", True, 5.0)


def test_a_mission_begun_in_1970_has_the_right_times(tmp_path: Path) -> None:
    rule = MissionRule("t", RULE.start, RULE.end, max_s=60.0)
    robot = Robot(tmp_path / "store", [rule], clock(wall=100 * NS, is_synchronised=False))
    robot.tell("STARTED", 3)
    robot.clock.wall, robot.clock.is_synchronised = 1_790_000_000 * NS, True
    robot.tell("STARTED", 3)
    robot.tell("DONE", 2)
    (mission,) = robot.missions
    assert mission.outcome == "done"
    assert lasted_s(mission) == pytest.approx(6.0, abs=1.1)
    assert mission.from_ns > 1_789_999_000 * NS
    table = LocalRecord(tmp_path / "store").query("ros_task", missions=[mission])
    assert 5 <= len(table) <= 7


def test_a_rule_that_cannot_be_judged_is_told_once(tmp_path: Path) -> None:
    robot = Robot(tmp_path / "store", [MissionRule("x", "ros_task.state > 3", RULE.end), RULE])
    robot.tell("STARTED", 2)
    robot.tell("DONE", 2)
    assert [m.name for m in robot.missions] == ["transport"]
    robot.close()
    kinds = LocalRecord(robot.store).events().values("kind")
    assert kinds.count("mission_rule") == 1


def test_the_keeper_looks_after_missions(tmp_path: Path) -> None:
    robot = Robot(tmp_path / "store", rules=())
    robot.tell("STARTED", 2)
    options = RetentionOptions(missions=(RULE,), quota_percent=100.0, min_free=0)
    keeper = RetentionService(open_store(robot.store), options, clock=robot.clock)
    keeper.step(threading.Event())
    assert [m.outcome for m in robot.missions] == [""]
    robot.tell("DONE", 2)
    keeper.step(threading.Event())
    assert [m.outcome for m in robot.missions] == ["DONE"]
    keeper.close()
    robot.box.close()


# -- whatever dies and begins again


@dataclass
class MortalRobot(Robot):
    """A robot whose recorder and keeper die at any moment; ``told`` is the true history."""

    keep: Literal["all", "ring"] = "all"
    rotate_ns: int = 600 * NS
    told: list[tuple[int, str]] = field(default_factory=list)

    def _new_box(self) -> ManualBox:
        options = PipelineOptions(boot_id=BOOT[:8], rotate_ns=self.rotate_ns)
        topics = [TopicOptions("/task", keep=self.keep)]
        return ManualBox(self.store, topics, clock=self.clock, options=options)

    def live(self, rnd: random.Random) -> None:
        keeper: MissionService | None = None
        for _ in range(rnd.randint(3, 25)):
            match rnd.choice([*"hhhhhhsssdd", "restart", "crash", "quiet"]):
                case "h":
                    self.hear(rnd.choice(["STARTED", "STARTED", "DONE", "IDLE"]))
                    self.box.write(rnd.choice([0.1, 1.0]))
                case "s":
                    keeper = keeper or self._new_keeper()
                    keeper.step()
                case "d":
                    keeper = _die(keeper, clean=rnd.random() < 0.3)
                case "quiet":
                    for _ in range(rnd.randint(1, 8)):
                        self.box.write(1.0)
                case end:
                    self.box.close() if end == "restart" else self.box.crash()
                    self.clock.advance(rnd.choice([0.5, 30]))
                    self.box = self._new_box()
        self.box.close()
        for _ in range(2):
            keeper = keeper or self._new_keeper()
            keeper.step()
            keeper = _die(keeper, clean=rnd.random() < 0.5)

    def hear(self, state: str) -> None:
        self.told.append((self.clock.wall, state))
        self.box.hear(TASK, msgspec.json.encode({"state": state, "goal": ""}))

    @property
    def truth(self) -> list[tuple[int, int | None]]:
        edges, before = [], "IDLE"
        for at_ns, state in self.told:
            if (state == "STARTED") != (before == "STARTED"):
                edges.append(at_ns)
            before = state
        return list(zip_longest(edges[::2], edges[1::2]))


def _die(keeper: MissionService | None, *, clean: bool) -> MissionService | None:
    if keeper is not None and clean:
        keeper.close()
    return None


@pytest.mark.parametrize("keep", ["all", "ring"])
@pytest.mark.parametrize("seed", range(2))
def test_missions_are_told_once_whatever_dies(
    tmp_path: Path, seed: int, keep: Literal["all", "ring"]
) -> None:
    for number in range(5 * seed, 5 * seed + 5):
        rnd = random.Random(number)
        rotate_ns = rnd.choice([2 * NS, 600 * NS])
        robot = MortalRobot(tmp_path / f"store{number}", keep=keep, rotate_ns=rotate_ns)
        robot.live(rnd)
        found = robot.missions
        assert [(m.from_ns, m.to_ns) for m in found] == robot.truth, number
        told = len(found) + sum(m.to_ns is not None for m in found)
        assert not told or len(LocalRecord(robot.store).query("amberbox_mission")) == told, number


def test_a_keeper_that_begins_amid_steps_of_the_clock_goes_on_where_it_was(robot: Robot) -> None:
    robot.tell("STARTED", 2)
    robot.clock.step(-3.0)
    robot.tell("STARTED", 1)
    robot.keeper.close()
    robot.keeper = robot._new_keeper()
    robot.clock.step(3.0)
    robot.tell("DONE")
    robot.tell("STARTED")
    robot.tell("DONE")
    assert [mission.outcome for mission in robot.missions] == ["DONE", "DONE"]


# -- by hand


def test_missions_are_begun_and_ended_by_hand_without_a_keeper(tmp_path: Path) -> None:
    create_store(tmp_path / "store")
    begun = start(tmp_path / "store", "test-drive", parameters={"load": "2 kg"}, who="ann")
    assert load(tmp_path / "store") == [begun]
    assert (begun.who, begun.parameters, begun.to_ns) == ("ann", {"load": "2 kg"}, None)
    ended = end(tmp_path / "store", begun.id, outcome="failed")
    assert (ended.id, ended.failed) == (begun.id, True)
    assert load(tmp_path / "store") == [ended]
    with pytest.raises(UsageError, match="no mission lasts"):
        end(tmp_path / "store")


def test_a_running_keeper_does_it(robot: Robot) -> None:
    robot.tell("IDLE")
    values = {"action": "start", "name": "visit", "id": "visit-1", "boot_id": BOOT}
    path = submit(open_store(robot.store), "mission", values)
    robot.keeper.step()
    assert not path.exists()
    assert [m.id for m in robot.missions] == ["visit-1"]
    submit(open_store(robot.store), "mission", {"action": "end", "id": "nobody"})
    robot.keeper.step()
    robot.close()
    assert LocalRecord(robot.store).events().values("kind")[-1] == "mission_refused"


def test_a_keeper_that_does_not_answer_is_an_error_and_leaves_nothing(tmp_path: Path) -> None:
    store = create_store(tmp_path / "store")
    lock = WriterLock(store, "keeper")
    with pytest.raises(AmberboxError, match="does not answer"):
        start(store.path, "visit", patience_s=0.0)
    lock.release()
    assert list((store.path / "requests").iterdir()) == []


@pytest.mark.parametrize("name", ["", "Two Words", "a/b"])
def test_names_are_ids(tmp_path: Path, name: str) -> None:
    create_store(tmp_path / "store")
    with pytest.raises(UsageError, match="is no id"):
        start(tmp_path / "store", name)


# -- asked for


@pytest.fixture
def three(robot: Robot) -> Robot:
    for outcome in ("DONE", "FAILED", "FAILED"):
        robot.tell("IDLE", 2)
        robot.tell("STARTED", 3)
        robot.tell(outcome)
    robot.close()
    return robot


def test_the_rows_of_the_last_failed_missions_are_asked_for(three: Robot) -> None:
    record = LocalRecord(three.store)
    missions = record.missions("transport", failed=True, last=2)
    table = record.query("ros_task", ["state"], missions=missions)
    assert table.names == ["timestamp", "mission", "state"]
    assert table.values("state") == ["STARTED"] * 6
    assert table.values("mission") == [missions[0].id] * 3 + [missions[1].id] * 3
    alone = record.query("ros_task", ["state"], missions=missions[:1])
    assert (alone.names, len(alone)) == (["timestamp", "state"], 3)
    with pytest.raises(UsageError, match="no mission"):
        record.query("ros_task", missions=[])


def test_words_stand_for_missions(three: Robot) -> None:
    known = three.missions
    assert missions_named(known, known[0].id) == known[:1]
    assert missions_named(known, "last") == known[2:]
    assert missions_named(known, "last:2") == known[1:]
    assert missions_named(known, "failed:9") == known[1:]
    assert missions_named(known, "transport:3") == known
    for wrong in ("visit", "last:0", "last:x"):
        with pytest.raises(UsageError):
            missions_named(known, wrong)
    with pytest.raises(UsageError, match="no mission has failed"):
        missions_named(known[:1], "failed:3")


def test_missions_are_chosen_by_time(three: Robot) -> None:
    first, second, _ = three.missions
    assert choose(three.missions, span=(first.to_ns, second.from_ns + 1)) == [second]
    assert choose(three.missions, "visit") == []


# -- found later


def test_missions_are_found_in_what_was_recorded(tmp_path: Path) -> None:
    robot = Robot(tmp_path / "store", rules=())
    robot.tell("IDLE", 2)
    robot.tell("STARTED", 3, goal="hall")
    robot.tell("DONE", 2)
    robot.tell("STARTED", 2)
    robot.close()
    found, notes = detect(robot.store, [RULE])
    assert [(m.outcome, m.parameters) for m in found] == [
        ("DONE", {"goal": "hall"}), ("", {"goal": ""}),
    ]  # fmt: skip
    assert notes == []
    assert robot.missions == found
    assert detect(robot.store, [RULE]) == ([], [])


def test_a_mission_without_end_in_what_was_recorded_times_out(tmp_path: Path) -> None:
    robot = Robot(tmp_path / "store", [])
    robot.tell("STARTED", 8)
    robot.close()
    rule = MissionRule("t", RULE.start, RULE.end, max_s=5.0)
    (mission,), _ = detect(robot.store, [rule])
    assert (mission.outcome, lasted_s(mission)) == ("timeout", 5.0)


def test_live_and_later_find_the_same(three: Robot) -> None:
    assert detect(three.store, [RULE]) == ([], [])
    _, notes = detect(three.store, [MissionRule("x", "nothing.x > 1", "nothing.x < 1")])
    assert "nothing" in notes[0]


def test_rules_survive_the_way_to_the_keepers_process() -> None:
    options = RetentionOptions(missions=(RULE,))
    assert RetentionOptions.from_json(options.to_json()) == options


def test_an_id_is_made_of_name_and_time() -> None:
    assert id_of("transport", 1_790_000_000_123 * 1_000_000) == "transport-20260921t141320.123"
    assert RecordedMission("a", "b", MissionInstant(5)).ended(MissionInstant(7), "aborted").failed
