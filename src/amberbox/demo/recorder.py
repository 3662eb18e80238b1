"""The recorder's demonstration: a simulated robot, a recorder that is killed once, and no data
loss.
"""

from __future__ import annotations

import atexit
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import amberbox
from amberbox.blackbox.sources.sim import FOLDER
from amberbox.blackbox.store import journal_reader
from amberbox.blackbox.store.incident import load_all
from amberbox.blackbox.store.store import open_store
from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError

FAULT = "wheel_front_left_motor_weak"
# a fault that the monitors find within seconds, and its component
SLOW, SLOWED = "laser_rear_motor_slow", "laser_rear"
SHOWN = ("sensors_front_left_current_1_q", "sensors_front_right_current_1_q")
WEAK = " - ".join(f"abs(zmq_wheels.{name})" for name in SHOWN)
TRIGGER = f"""triggers:
- name: uneven_wheels
  when: {WEAK} > 0.4 for 500ms
  before: 2s
  after: 2s
  reason: a wheel draws more current than its neighbour
"""
PASSENGER = "recording_odom"
# the failure mode that explains it best
SUSPECT = "laser_rear#motor_slow"
_LOST_AT_KILL_S = 0.15


def run(place: Path, seconds: float) -> int:
    """Run it in an empty folder; return 0 only if every step worked."""
    demo = Demo(place, seconds)
    steps = (demo.prepare, demo.record, demo.report_status, demo.diagnose, demo.account, demo.show)
    for step in (*steps, demo.defend):
        step()
    print(f"\nEverything is in {place}. Go on with:")
    for verb in (
        "items {}",
        "watch {} --replay",
        "query {} zmq_odom --points 5",
        "sql {} 'select count(*) from zmq_imu'",
        "query {} zmq_wheels --incident last --points 5",
    ):
        print("  amberbox " + verb.format(demo.folder))
    return 0


@dataclass
class Demo:
    """The demonstration, step by step."""

    place: Path
    seconds: float
    kills_ns: list[int] = field(default_factory=list)

    @property
    def folder(self) -> Path:
        """The robot folder."""
        return self.place / "robot"

    @property
    def watched(self) -> Path:
        """The file with the monitors' output."""
        return self.place / "watched.txt"

    @property
    def truth(self) -> Path:
        """The file with the messages that the robot has sent."""
        return self.place / "truth.jsonl"

    def prepare(self) -> None:
        """Make a recording that will be replayed beside the robot."""
        title("A recording is made: a minute of a simulated robot, as fast as the machine can.")
        maker = self.place / "maker"
        sim = "seed: 3\n    speed: max\n    duration_s: 60"
        write_folder(
            maker, "maker", f"- sim:\n    {sim}\n    topics: [{{topic: {{name: odom}}}}]\n"
        )
        amberbox_verb("record", str(maker), "--quiet")
        journal = next(iter(sorted((maker / "store" / "journal").glob("*.mcap"))))
        self.recording = self.place / "yesterday.mcap"
        self.recording.write_bytes(journal.read_bytes())
        rows = journal_reader.journal_file(self.recording).items.get("sim_odom", 0)
        self.recorded_before = rows
        check(rows > 0, f"{rows} messages in {self.recording.name}, an ordinary MCAP file")

    def record(self) -> None:
        """Record the live robot and the recording; kill the recorder once; inject a fault."""
        title(
            "A simulated robot speaks ZMQ; the black box listens, and replays the recording beside."
        )
        with robot(self.truth) as (process, endpoint):
            write_folder(self.folder, "demo_robot", self._blocks(endpoint), TRIGGER)
            copy_knowledge(self.folder, "sim_", "zmq_")
            box = start_box(self.folder)
            watcher = start_watcher(self.folder, self.watched)
            time.sleep(self.seconds * 0.3)
            command_robot(process, f"fault {FAULT}")
            print(f"  a fault begins: {FAULT}")
            time.sleep(self.seconds * 0.2)
            box.send_signal(signal.SIGKILL)
            box.wait()
            self.kills_ns.append(time.time_ns())
            print("  the box is killed with kill -9, and started again")
            box = start_box(self.folder)
            time.sleep(self.seconds * 0.35)
            command_robot(process, f"fault {SLOW}")
            print(f"  another fault begins: {SLOW}")
            wait_until(lambda: bool(self.failures()), 60.0)
            time.sleep(self.seconds * 0.1)
            self.look()
        time.sleep(0.5)
        watcher.send_signal(signal.SIGTERM)
        check(watcher.wait(60) == 0, "the monitors stopped cleanly")
        box.send_signal(signal.SIGTERM)
        check(box.wait(30) == 0, "the box stopped cleanly")

    def look(self) -> None:
        """Show the robot's status while it runs."""
        title("How is the robot? Its monitors follow the record while it is written.")
        amberbox_verb("status", str(self.folder), expected=1)
        amberbox_verb("alarm", str(self.folder))

    def failures(self) -> list[str]:
        """Return the lines of the monitors about the second fault so far."""
        lines = self.watched.read_text().splitlines()
        return [line for line in lines if SLOWED in line and "speed_right is false" in line]

    def report_status(self) -> None:
        """Show the lines of the monitors about the second fault."""
        title("What the monitors said of the second fault, as it came:")
        print("\n".join(f"  {line}" for line in self.failures()))
        check(bool(self.failures()), f"the monitors saw that the motor of {SLOWED} is slow")

    def diagnose(self) -> None:
        """Show the diagnosis and what to do next."""
        title("What is broken? One answer from all that was seen, by the robot's failure modes:")
        amberbox_verb("diagnose", str(self.folder), expected=1)
        command = [sys.executable, "-m", "amberbox", "diagnose", str(self.folder), "--json"]
        answer = json.loads(subprocess.run(command, stdout=subprocess.PIPE, check=False).stdout)
        first = answer["groups"][0]["faults"] if answer["groups"] else []
        blamed = bool(first) and all(SUSPECT in faults for faults in first)
        check(blamed, f"{SUSPECT} is to blame first of all")

    def _blocks(self, endpoint: str) -> str:
        return (
            f"- zmq:\n    endpoint: {endpoint}\n    topics: []\n"
            f"- recording:\n    path: {self.recording.resolve()}\n    speed: 20\n"
        )

    def account(self) -> None:
        """Compare the record with the messages that the robot has sent."""
        title("Is anything lost? The robot's own account against the record:")
        sent = sent_messages(self.truth)
        kept = kept_messages(self.folder / "store")
        gaps: dict[str, list[tuple[int, int]]] = {}
        for gap in amberbox.open(self.folder).gaps():
            gaps.setdefault(gap.item, []).append((gap.from_ns, gap.to_ns))
        lost = {key: at for key, at in sent.items() if key not in kept}
        explained = sum(
            self._may_be_missing(at, gaps.get(f"zmq_{topic}", []))
            for (topic, _), at in lost.items()
        )
        doubled = sum(count - 1 for count in kept.values())
        lost_for_good = len(lost) - explained
        print(f"  sent {len(sent)}, recorded {len(kept)}, missing while the box was dead"
              f" {explained}, lost {lost_for_good}")  # fmt: skip
        check(len(kept) > 0 and not doubled, "every message is there once")
        check(explained == len(lost), "what is missing lies in the gap that the record names")

    def _may_be_missing(self, at_ns: int, gaps: list[tuple[int, int]]) -> bool:
        """Return whether a message may be missing: within a gap, or just before a kill."""
        edge = round(_LOST_AT_KILL_S * NS)
        in_gap = any(start - edge <= at_ns <= end + edge for start, end in gaps)
        return in_gap or any(kill - edge <= at_ns <= kill for kill in self.kills_ns)

    def show(self) -> None:
        """Show the items, and the fault in a plot."""
        title("What is in the record:")
        amberbox_verb("items", str(self.folder))
        for name in ("fault.png", "fault.html"):
            plot = self.place / name
            amberbox_verb("plot", str(self.folder), "zmq_wheels", *SHOWN, "-o", str(plot))
            check(plot.stat().st_size > 1000, f"the currents of two wheels are drawn in {plot}")
        record = amberbox.open(self.folder)
        rows = sum(item.rows for item in record.items() if item.name == PASSENGER)
        check(rows > 0, f"{rows} messages of the recording went the same way")

    def defend(self) -> None:
        """Show the incident that is kept, and that a changed bit of the record is found."""
        title("The fault was noticed: the seconds around it stay whatever else has to go.")
        amberbox_verb("incident", "list", str(self.folder))
        held = load_all(open_store(self.folder / "store"))
        check(any(reason.trigger == "uneven_wheels" for i in held for reason in i.reasons),
              "an incident was made by its trigger")  # fmt: skip
        title("Is the record as the robot left it? One bit of a copy is changed as well.")
        amberbox_verb("verify", str(self.folder))
        forged = self.place / "forged"
        shutil.copytree(self.folder / "store", forged)
        flip_a_bit(max((forged / "journal").glob("*.mcap"), key=lambda path: path.stat().st_size))
        amberbox_verb("verify", str(forged), expected=1)
        shutil.rmtree(forged)
        check(True, "the record is intact, and the bit was found in its copy")


def title(text: str) -> None:
    """Announce a step."""
    print(f"\n== {text}", flush=True)


def check(fine: bool, text: str) -> None:
    """Print the outcome of a step; stop the demonstration when it failed."""
    if not fine:
        raise AmberboxError(f"the demonstration failed: not true that {text}", "please report this")
    print(f"  ok: {text}", flush=True)


def write_folder(folder: Path, name: str, blocks: str, more: str = "") -> None:
    """Write a robot folder; ``more`` is added to its ``robot.yaml``."""
    folder.mkdir(exist_ok=True)
    (folder / "robot.yaml").write_text(f"id: {name}\n{more}")
    (folder / "black_box.yaml").write_text(blocks)


def copy_knowledge(folder: Path, old: str, new: str) -> None:
    """Copy the folder of the simulated robot, but for its sources, with a text replaced."""
    kinds = ("*.yaml", "*.pl", "*.bpmn", "*.py")
    for path in (path for kind in kinds for path in FOLDER.rglob(kind)):
        if path.name != "black_box.yaml":
            target = folder / path.relative_to(FOLDER)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(path.read_text("utf-8").replace(old, new), "utf-8")


def flip_a_bit(path: Path) -> None:
    """Change one bit in the middle of a file."""
    with path.open("r+b") as file:
        file.seek(path.stat().st_size // 2)
        byte = file.read(1)[0]
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([byte ^ 1]))


def amberbox_verb(*arguments: str, expected: int = 0) -> None:
    """Run a verb as a user would; raises AmberboxError for another exit status."""
    print("  $ amberbox " + " ".join(arguments), flush=True)
    done = subprocess.run([sys.executable, "-m", "amberbox", *arguments], check=False)
    if done.returncode != expected:
        raise AmberboxError(f"amberbox {arguments[0]} ended with {done.returncode}", "see above")


def start_box(folder: Path) -> subprocess.Popen[bytes]:
    """Start recording and wait until the first journal exists."""
    before = journals(folder)
    command = [sys.executable, "-m", "amberbox", "record", str(folder), "--quiet"]
    box = subprocess.Popen(command, start_new_session=True)
    atexit.register(box.kill)  # the recorder ends with the demonstration
    wait_until(lambda: len(journals(folder)) > len(before) or box.poll() is not None)
    check(box.poll() is None, "the box records")
    return box


def start_watcher(folder: Path, output: Path) -> subprocess.Popen[bytes]:
    """Start the monitors; their findings go to a file."""
    command = [sys.executable, "-m", "amberbox", "watch", str(folder)]
    with output.open("wb") as file:
        watcher = subprocess.Popen(command, start_new_session=True, stdout=file)
    atexit.register(watcher.kill)
    return watcher


def journals(folder: Path) -> list[Path]:
    """Return the journal files of a robot folder."""
    return sorted((folder / "store" / "journal").glob("*.mcap"))


def wait_until(condition: Callable[[], bool], timeout_s: float = 30.0) -> None:
    """Wait for a condition; raises AmberboxError after ``timeout_s`` seconds."""
    end = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end:
            raise AmberboxError("the demonstration waited in vain", "is the machine very busy?")
        time.sleep(0.02)


@contextmanager
def robot(truth: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run the simulated robot; it begins to move when the recorder listens."""
    command = [sys.executable, "-m", "amberbox.sim", "--zmq", "tcp://127.0.0.1:*", "--wait"]
    process = subprocess.Popen(
        [*command, "--seed", "7", "--truth", str(truth)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    assert process.stdout is not None
    try:
        yield process, process.stdout.readline().split()[-1]
    finally:
        process.terminate()
        process.wait(10)


def command_robot(process: subprocess.Popen[str], line: str) -> None:
    """Send the simulated robot a command."""
    assert process.stdin is not None
    process.stdin.write(line + "\n")
    process.stdin.flush()


def sent_messages(truth: Path) -> dict[tuple[str, int], int]:
    """Return the stamp (ns) of every sent message, by topic and number."""
    lines = [json.loads(line) for line in truth.read_text().splitlines() if line.endswith("}")]
    return {(line["topic"], line["seq"]): line["stamp_ns"] for line in lines}


def kept_messages(store: Path) -> Counter[tuple[str, int]]:
    """Return how often each message is in the record, by topic and number."""
    kept: Counter[tuple[str, int]] = Counter()
    for batch in journal_reader.batches(store):
        if batch.source == "zmq" and "header_seq" in batch.columns:
            numbers = np.asarray(batch.columns["header_seq"]).tolist()
            kept.update((batch.topic, number) for number in numbers)
    return kept
