"""All children of a box: who is first, who is last, and what a changed folder does to them."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from amberbox.blackbox.doctor.supervised import STATE_FILE
from amberbox.blackbox.keeper.remarks import KIND
from amberbox.blackbox.requests import pending
from amberbox.blackbox.service import SPENT
from amberbox.blackbox.store import create_store
from amberbox.core.errors import UsageError
from amberbox.robot.supervisor import changes
from amberbox.robot.supervisor.child import children_of
from amberbox.robot.supervisor.judgement import Judgement
from amberbox.robot.supervisor.supervisor import Box, Supervisor
from tests.robot.supervisor.puppet import Theatre

READY = ("READY", "1")


@dataclass
class Answer:
    """A judgement that is there at once."""

    judgement: Judgement

    def answer(self, now_s: float) -> Judgement | None:
        return self.judgement

    def close(self) -> None:
        pass


@dataclass
class Stage:
    """A supervisor of puppets, its clock, and what would be said about its folder."""

    folder: Path
    theatre: Theatre = field(default_factory=Theatre)
    said: list[str] = field(default_factory=list)
    judgement: Judgement = field(default_factory=lambda: Judgement(True, "", "one"))
    now_s: float = 0.0

    def __post_init__(self) -> None:
        store = create_store(self.folder / "store")
        self.box = Box(self.folder, store, "one", children_of(self.folder, 0.1))
        self.supervisor = Supervisor(
            self.box, launch=self.theatre.launch, out=self.said.append, clock_s=lambda: self.now_s
        )
        self.supervisor._changes = changes.Changes(
            self.folder, store.path, lambda *_: Answer(self.judgement)
        )

    def pass_(self, seconds: float, alive: bool = True) -> None:
        """Let time pass; children give signs of life."""
        for _ in range(round(seconds / 0.5)):
            self.now_s += 0.5
            for puppet in self.theatre.puppets if alive else ():
                puppet.tell(("WATCHDOG", "1"))
            self.supervisor.turn()

    def begin(self) -> None:
        """Have both children up."""
        self.pass_(1)
        self.theatre.of("record").tell(READY)
        self.pass_(1)
        self.theatre.of("watch").tell(READY)
        self.pass_(1)

    def kinds(self) -> list[str]:
        return [line.split()[1].rstrip(":") for line in self.said if line[2] == ":"]


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    folder = tmp_path / "robot"
    (folder / "components").mkdir(parents=True)
    (folder / "robot.yaml").write_text("id: r\n")
    (folder / "black_box.yaml").write_text("- sim: {seed: 1}\n")
    (folder / "components" / "motor.yaml").write_text("component_name: motor\n")
    made = Stage(folder)
    yield made
    made.supervisor.close()


def test_the_recorder_is_first(stage: Stage) -> None:
    stage.pass_(2)
    assert stage.theatre.names == ["record"]
    stage.theatre.last.tell(READY)
    stage.pass_(1)
    assert stage.theatre.names == ["record", "watch"]


def test_a_recorder_that_is_never_ready_does_not_hold_up_the_watcher(stage: Stage) -> None:
    stage.pass_(6)
    assert stage.theatre.names == ["record", "watch"]


def test_the_recorder_goes_on_while_the_watcher_dies_again_and_again(stage: Stage) -> None:
    stage.begin()
    for _ in range(5):
        stage.theatre.of("watch").status = -9
        stage.pass_(35)
    assert stage.theatre.names.count("record") == 1
    assert stage.theatre.names.count("watch") == 6
    assert stage.theatre.of("record").sent == []


def test_the_watcher_ends_before_the_recorder(stage: Stage) -> None:
    stage.begin()
    watch, record = stage.theatre.of("watch"), stage.theatre.of("record")
    watch.obeys = False
    stage.supervisor.stop()
    stage.pass_(2)
    assert watch.sent == [signal.SIGTERM] and record.sent == []
    stage.pass_(4)
    assert watch.sent[:2] == [signal.SIGTERM, signal.SIGKILL]
    assert record.sent == [signal.SIGTERM]
    assert stage.supervisor.is_over and stage.now_s < 3 + 10
    assert stage.theatre.names == ["record", "watch"]


def test_all_of_it_ends_within_ten_seconds(stage: Stage) -> None:
    stage.begin()
    for puppet in stage.theatre.puppets:
        puppet.obeys = False
    stage.supervisor.stop()
    stage.pass_(10)
    assert stage.supervisor.is_over


def test_a_second_signal_hurries(stage: Stage) -> None:
    stage.begin()
    for puppet in stage.theatre.puppets:
        puppet.obeys = False
    stage.supervisor.stop()
    stage.pass_(0.5)
    stage.supervisor.stop()
    stage.pass_(3)
    assert stage.supervisor.is_over
    assert stage.theatre.of("record").sent[:2] == [signal.SIGTERM, signal.SIGKILL]


def test_it_ends_when_the_recorder_has_nothing_left_to_record(stage: Stage) -> None:
    stage.begin()
    stage.theatre.of("record").tell(("STATUS", SPENT))
    stage.theatre.of("record").status = 0
    stage.pass_(2)
    assert stage.supervisor.is_over
    assert stage.theatre.of("watch").sent == [signal.SIGTERM]


def test_without_components_nothing_watches_until_there_are_some(tmp_path: Path) -> None:
    (tmp_path / "black_box.yaml").write_text("- sim: {seed: 1}\n")
    stage = Stage(tmp_path)
    stage.pass_(8)
    assert stage.theatre.names == ["record"]
    (tmp_path / "components").mkdir()
    (tmp_path / "components" / "motor.yaml").write_text("component_name: motor\n")
    stage.judgement = Judgement(True, "", "two")
    stage.pass_(8)
    assert stage.theatre.names == ["record", "watch"]
    stage.supervisor.close()


def test_a_changed_folder_is_watched_anew_and_recorded_on(stage: Stage) -> None:
    stage.begin()
    (stage.folder / "components" / "motor.yaml").write_text("component_name: engine\n")
    stage.judgement = Judgement(True, "", "two")
    stage.pass_(8)
    assert stage.theatre.names == ["record", "watch", "watch"]
    assert stage.kinds() == ["configuration_changed"]
    stage.pass_(60)
    assert stage.theatre.names == ["record", "watch", "watch"]


def test_an_error_in_the_folder_leaves_everything_running(stage: Stage) -> None:
    stage.begin()
    (stage.folder / "components" / "motor.yaml").write_text("component_name: [\n")
    stage.judgement = Judgement(False, "components/motor.yaml:1: no end")
    stage.pass_(30)
    assert stage.theatre.names == ["record", "watch"]
    assert stage.kinds() == ["configuration_refused"]
    assert "components/motor.yaml:1: no end; what runs goes on as it is" in stage.said[-1]


def test_a_folder_that_is_being_written_is_left_to_rest(stage: Stage) -> None:
    stage.begin()
    stage.judgement = Judgement(True, "", "two")
    for n in range(10):
        (stage.folder / "components" / "motor.yaml").write_text("#" * n)
        stage.pass_(2)
    assert stage.theatre.names == ["record", "watch"]
    stage.pass_(8)
    assert stage.theatre.names == ["record", "watch", "watch"]


def test_only_a_reload_makes_the_recorder_begin_anew(stage: Stage) -> None:
    stage.begin()
    (stage.folder / "black_box.yaml").write_text("- sim: {seed: 2}\n")
    stage.judgement = Judgement(True, "", "two")
    stage.pass_(10)
    assert stage.theatre.names == ["record", "watch", "watch"]
    assert "the recorder goes on as it began" in stage.said[-1]
    stage.supervisor.reload()
    stage.pass_(3)
    assert stage.theatre.names == ["record", "watch", "watch", "record"]
    stage.supervisor.reload()
    stage.pass_(3)
    assert stage.theatre.names == ["record", "watch", "watch", "record"]
    assert stage.said[-1] == "nothing has changed in the folder"


def test_another_store_waits_for_a_restart(stage: Stage) -> None:
    stage.begin()
    (stage.folder / "robot.yaml").write_text("store: {path: elsewhere}\n")
    stage.judgement = Judgement(True, "", "two", str(stage.folder / "elsewhere"))
    stage.pass_(10)
    assert stage.theatre.names == ["record", "watch"]
    assert "stop and start" in stage.said[-1]


def test_a_change_brings_back_what_was_refused(stage: Stage) -> None:
    stage.begin()
    stage.theatre.of("watch").status = 2
    stage.pass_(1)
    (stage.folder / "components" / "motor.yaml").write_text("component_name: engine\n")
    stage.judgement = Judgement(False, "fmea.yaml:1: wrong")
    stage.pass_(8)
    assert stage.theatre.names == ["record", "watch", "watch"]


def test_a_store_has_one_supervisor(stage: Stage) -> None:
    with pytest.raises(UsageError, match="is being written by process"):
        Supervisor(stage.box)


def test_what_happened_is_left_for_the_record_and_for_others(stage: Stage) -> None:
    stage.begin()
    stage.theatre.of("watch").status = -9
    stage.pass_(5)
    stage.supervisor.stop()
    stage.pass_(5)
    stage.supervisor.close()
    left = [request for request in pending(stage.box.store) if request.kind == KIND]
    assert [request.values["kind"] for request in left] == ["process_died"]
    assert left[0].values["source"] == "run"
    state = json.loads((stage.box.store.path / STATE_FILE).read_text())
    assert state["children"]["watch"]["restarts"] == 1
    assert state["children"]["record"]["state"] == "off"


def joined(stage: Stage) -> None:
    """Have the folder name a server, with a key to it."""
    (stage.folder / "robot.yaml").write_text("id: r1\nserver: {url: 'https://fleet.example'}\n")
    (stage.folder / "server.key").write_text("abr_key\n")


def test_a_folder_that_joins_a_server_is_linked_from_then_on(stage: Stage) -> None:
    stage.begin()
    joined(stage)
    stage.judgement = Judgement(True, "", "two")
    stage.pass_(10)
    assert sorted(stage.theatre.names) == ["link", "record", "watch", "watch"]
    assert stage.supervisor._known["link"]["state"] == "starting"


def test_another_key_lets_only_the_link_begin_anew(stage: Stage) -> None:
    joined(stage)
    stage.supervisor._wanted = stage.supervisor._wishes()
    stage.begin()
    stage.pass_(10)
    before = stage.theatre.names.count("link")
    (stage.folder / "server.key").write_text("abr_another\n")
    stage.judgement = Judgement(True, "", "one")
    stage.pass_(15)
    assert stage.theatre.names.count("link") == before + 1
    assert stage.theatre.names.count("watch") == stage.theatre.names.count("record") == 1


def test_the_link_ends_when_all_others_have(stage: Stage) -> None:
    joined(stage)
    stage.supervisor._wanted = stage.supervisor._wishes()
    stage.begin()
    stage.theatre.of("link").tell(READY)
    for name in ("watch", "record"):
        stage.theatre.of(name).obeys = False
    stage.pass_(1)
    stage.supervisor.stop()
    stage.pass_(1)
    assert signal.SIGTERM not in stage.theatre.of("link").sent
    assert signal.SIGTERM in stage.theatre.of("watch").sent
    stage.theatre.of("watch").status = 0
    stage.pass_(1)
    assert signal.SIGTERM in stage.theatre.of("record").sent
    assert signal.SIGTERM not in stage.theatre.of("link").sent
    stage.theatre.of("record").status = 0
    stage.pass_(1)
    assert signal.SIGTERM in stage.theatre.of("link").sent


def test_without_a_key_there_is_nothing_to_link(stage: Stage) -> None:
    joined(stage)
    (stage.folder / "server.key").unlink()
    stage.supervisor._wanted = stage.supervisor._wishes()
    stage.begin()
    assert stage.theatre.names == ["record", "watch"]
