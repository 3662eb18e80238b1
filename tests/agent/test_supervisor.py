"""All children of a box: who is first, who is last, and what a changed folder does to them."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from amberbox.agent import folder_changes
from amberbox.agent.doctor.processes import SUPERVISOR_STATE_FILE
from amberbox.agent.folder_changes import FolderVerdict
from amberbox.agent.process import children_of
from amberbox.agent.supervisor import ProcessSupervisor, SupervisedBox
from amberbox.blackbox.store.store import EVENT_REQUEST, create_store, pending
from amberbox.core.errors import UsageError
from amberbox.core.systemd import ALL_INPUTS_ENDED
from tests.agent.fake_process import FakeLauncher

READY = ("READY", "1")


@dataclass
class Answer:
    """A judgement that is there at once."""

    judgement: FolderVerdict

    def answer(self, now_s: float) -> FolderVerdict | None:
        return self.judgement

    def close(self) -> None:
        pass


@dataclass
class SupervisorBench:
    """A supervisor of fake processes, its clock, and the result of checking its folder."""

    folder: Path
    launcher: FakeLauncher = field(default_factory=FakeLauncher)
    said: list[str] = field(default_factory=list)
    judgement: FolderVerdict = field(default_factory=lambda: FolderVerdict(True, "", "one"))
    now_s: float = 0.0

    def __post_init__(self) -> None:
        store = create_store(self.folder / "store")
        self.box = SupervisedBox(self.folder, store, "one", children_of(self.folder, 0.1))
        self.supervisor = ProcessSupervisor(
            self.box, launch=self.launcher.launch, out=self.said.append, clock_s=lambda: self.now_s
        )
        self.supervisor._changes = folder_changes.FolderWatch(
            self.folder, store.path, lambda *_: Answer(self.judgement)
        )

    def pass_(self, seconds: float, alive: bool = True) -> None:
        """Let time pass; children give signs of life."""
        for _ in range(round(seconds / 0.5)):
            self.now_s += 0.5
            for fake in self.launcher.started if alive else ():
                fake.tell(("WATCHDOG", "1"))
            self.supervisor.turn()

    def begin(self) -> None:
        """Have both children up."""
        self.pass_(1)
        self.launcher.of("record").tell(READY)
        self.pass_(1)
        self.launcher.of("watch").tell(READY)
        self.pass_(1)

    def kinds(self) -> list[str]:
        return [line.split()[1].rstrip(":") for line in self.said if line[2] == ":"]


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[SupervisorBench]:
    folder = tmp_path / "robot"
    (folder / "components").mkdir(parents=True)
    (folder / "robot.yaml").write_text("id: r\n")
    (folder / "black_box.yaml").write_text("- sim: {seed: 1}\n")
    (folder / "components" / "motor.yaml").write_text("component_name: motor\n")
    made = SupervisorBench(folder)
    yield made
    made.supervisor.close()


def test_the_recorder_is_first(bench: SupervisorBench) -> None:
    bench.pass_(2)
    assert bench.launcher.names == ["record"]
    bench.launcher.last.tell(READY)
    bench.pass_(1)
    assert bench.launcher.names == ["record", "watch"]


def test_a_recorder_that_is_never_ready_does_not_hold_up_the_watcher(
    bench: SupervisorBench,
) -> None:
    bench.pass_(6)
    assert bench.launcher.names == ["record", "watch"]


def test_the_recorder_goes_on_while_the_watcher_dies_again_and_again(
    bench: SupervisorBench,
) -> None:
    bench.begin()
    for _ in range(5):
        bench.launcher.of("watch").status = -9
        bench.pass_(35)
    assert bench.launcher.names.count("record") == 1
    assert bench.launcher.names.count("watch") == 6
    assert bench.launcher.of("record").sent == []


def test_the_watcher_ends_before_the_recorder(bench: SupervisorBench) -> None:
    bench.begin()
    watch, record = bench.launcher.of("watch"), bench.launcher.of("record")
    watch.obeys = False
    bench.supervisor.stop()
    bench.pass_(2)
    assert watch.sent == [signal.SIGTERM] and record.sent == []
    bench.pass_(4)
    assert watch.sent[:2] == [signal.SIGTERM, signal.SIGKILL]
    assert record.sent == [signal.SIGTERM]
    assert bench.supervisor.is_over and bench.now_s < 3 + 10
    assert bench.launcher.names == ["record", "watch"]


def test_all_of_it_ends_within_ten_seconds(bench: SupervisorBench) -> None:
    bench.begin()
    for fake in bench.launcher.started:
        fake.obeys = False
    bench.supervisor.stop()
    bench.pass_(10)
    assert bench.supervisor.is_over


def test_a_second_signal_hurries(bench: SupervisorBench) -> None:
    bench.begin()
    for fake in bench.launcher.started:
        fake.obeys = False
    bench.supervisor.stop()
    bench.pass_(0.5)
    bench.supervisor.stop()
    bench.pass_(3)
    assert bench.supervisor.is_over
    assert bench.launcher.of("record").sent[:2] == [signal.SIGTERM, signal.SIGKILL]


def test_it_ends_when_the_recorder_has_nothing_left_to_record(bench: SupervisorBench) -> None:
    bench.begin()
    bench.launcher.of("record").tell(("STATUS", ALL_INPUTS_ENDED))
    bench.launcher.of("record").status = 0
    bench.pass_(2)
    assert bench.supervisor.is_over
    assert bench.launcher.of("watch").sent == [signal.SIGTERM]


def test_without_components_nothing_watches_until_there_are_some(tmp_path: Path) -> None:
    (tmp_path / "black_box.yaml").write_text("- sim: {seed: 1}\n")
    bench = SupervisorBench(tmp_path)
    bench.pass_(8)
    assert bench.launcher.names == ["record"]
    (tmp_path / "components").mkdir()
    (tmp_path / "components" / "motor.yaml").write_text("component_name: motor\n")
    bench.judgement = FolderVerdict(True, "", "two")
    bench.pass_(8)
    assert bench.launcher.names == ["record", "watch"]
    bench.supervisor.close()


def test_a_changed_folder_is_watched_anew_and_recorded_on(bench: SupervisorBench) -> None:
    bench.begin()
    (bench.folder / "components" / "motor.yaml").write_text("component_name: engine\n")
    bench.judgement = FolderVerdict(True, "", "two")
    bench.pass_(8)
    assert bench.launcher.names == ["record", "watch", "watch"]
    assert bench.kinds() == ["configuration_changed"]
    bench.pass_(60)
    assert bench.launcher.names == ["record", "watch", "watch"]


def test_an_error_in_the_folder_leaves_everything_running(bench: SupervisorBench) -> None:
    bench.begin()
    (bench.folder / "components" / "motor.yaml").write_text("component_name: [\n")
    bench.judgement = FolderVerdict(False, "components/motor.yaml:1: no end")
    bench.pass_(30)
    assert bench.launcher.names == ["record", "watch"]
    assert bench.kinds() == ["configuration_refused"]
    assert "components/motor.yaml:1: no end; what runs goes on as it is" in bench.said[-1]


def test_a_folder_that_is_being_written_is_left_to_rest(bench: SupervisorBench) -> None:
    bench.begin()
    bench.judgement = FolderVerdict(True, "", "two")
    for n in range(10):
        (bench.folder / "components" / "motor.yaml").write_text("#" * n)
        bench.pass_(2)
    assert bench.launcher.names == ["record", "watch"]
    bench.pass_(8)
    assert bench.launcher.names == ["record", "watch", "watch"]


def test_only_a_reload_makes_the_recorder_begin_anew(bench: SupervisorBench) -> None:
    bench.begin()
    (bench.folder / "black_box.yaml").write_text("- sim: {seed: 2}\n")
    bench.judgement = FolderVerdict(True, "", "two")
    bench.pass_(10)
    assert bench.launcher.names == ["record", "watch", "watch"]
    assert "the recorder goes on as it began" in bench.said[-1]
    bench.supervisor.reload()
    bench.pass_(3)
    assert bench.launcher.names == ["record", "watch", "watch", "record"]
    bench.supervisor.reload()
    bench.pass_(3)
    assert bench.launcher.names == ["record", "watch", "watch", "record"]
    assert bench.said[-1] == "nothing has changed in the folder"


def test_another_store_waits_for_a_restart(bench: SupervisorBench) -> None:
    bench.begin()
    (bench.folder / "robot.yaml").write_text("store: {path: elsewhere}\n")
    bench.judgement = FolderVerdict(True, "", "two", str(bench.folder / "elsewhere"))
    bench.pass_(10)
    assert bench.launcher.names == ["record", "watch"]
    assert "stop and start" in bench.said[-1]


def test_a_change_brings_back_what_was_refused(bench: SupervisorBench) -> None:
    bench.begin()
    bench.launcher.of("watch").status = 2
    bench.pass_(1)
    (bench.folder / "components" / "motor.yaml").write_text("component_name: engine\n")
    bench.judgement = FolderVerdict(False, "fmea.yaml:1: wrong")
    bench.pass_(8)
    assert bench.launcher.names == ["record", "watch", "watch"]


def test_a_store_has_one_supervisor(bench: SupervisorBench) -> None:
    with pytest.raises(UsageError, match="is being written by process"):
        ProcessSupervisor(bench.box)


def test_what_happened_is_left_for_the_record_and_for_others(bench: SupervisorBench) -> None:
    bench.begin()
    bench.launcher.of("watch").status = -9
    bench.pass_(5)
    bench.supervisor.stop()
    bench.pass_(5)
    bench.supervisor.close()
    left = [request for request in pending(bench.box.store) if request.kind == EVENT_REQUEST]
    assert [request.values["kind"] for request in left] == ["process_died"]
    assert left[0].values["source"] == "run"
    state = json.loads((bench.box.store.path / SUPERVISOR_STATE_FILE).read_text())
    assert state["children"]["watch"]["restarts"] == 1
    assert state["children"]["record"]["state"] == "off"


def joined(bench: SupervisorBench) -> None:
    """Have the folder name a server, with a key to it."""
    (bench.folder / "robot.yaml").write_text("id: r1\nserver: {url: 'https://fleet.example'}\n")
    (bench.folder / "server.key").write_text("abr_key\n")


def test_a_folder_that_joins_a_server_is_linked_from_then_on(bench: SupervisorBench) -> None:
    bench.begin()
    joined(bench)
    bench.judgement = FolderVerdict(True, "", "two")
    bench.pass_(10)
    assert sorted(bench.launcher.names) == ["act", "link", "record", "watch", "watch"]
    assert bench.supervisor._last_state["link"]["state"] == "starting"


def test_another_key_lets_only_the_link_begin_anew(bench: SupervisorBench) -> None:
    joined(bench)
    bench.supervisor._wanted = bench.supervisor._wanted_children()
    bench.begin()
    bench.pass_(10)
    before = bench.launcher.names.count("link")
    (bench.folder / "server.key").write_text("abr_another\n")
    bench.judgement = FolderVerdict(True, "", "one")
    bench.pass_(15)
    assert bench.launcher.names.count("link") == before + 1
    assert bench.launcher.names.count("watch") == bench.launcher.names.count("record") == 1


def test_the_link_ends_when_all_others_have(bench: SupervisorBench) -> None:
    joined(bench)
    bench.supervisor._wanted = bench.supervisor._wanted_children()
    bench.begin()
    bench.launcher.of("link").tell(READY)
    for name in ("watch", "record"):
        bench.launcher.of(name).obeys = False
    bench.pass_(1)
    bench.supervisor.stop()
    bench.pass_(1)
    assert signal.SIGTERM not in bench.launcher.of("link").sent
    assert signal.SIGTERM in bench.launcher.of("watch").sent
    bench.launcher.of("watch").status = 0
    bench.pass_(1)
    assert signal.SIGTERM in bench.launcher.of("record").sent
    assert signal.SIGTERM not in bench.launcher.of("link").sent
    bench.launcher.of("record").status = 0
    bench.pass_(1)
    assert signal.SIGTERM in bench.launcher.of("link").sent


def test_without_a_key_there_is_nothing_to_link(bench: SupervisorBench) -> None:
    joined(bench)
    (bench.folder / "server.key").unlink()
    bench.supervisor._wanted = bench.supervisor._wanted_children()
    bench.begin()
    assert bench.launcher.names == ["record", "watch"]
