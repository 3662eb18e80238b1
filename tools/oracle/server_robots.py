"""Robots with records for the server: simulated on virtual time, watched, and linked to it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mcap.reader
import mcap.writer

from tools.oracle.server_asking import Book, Person
from tools.oracle.side import NS, Completed, Side

PATIENCE_S = 40.0
DRIVE_NS = 1_767_600_000 * NS
"""When simulated robots start: 2026-01-05T08:00:00Z."""
_POLL_S = 0.05
_QUIET_S = 0.4
_ROBOT = """\
id: {id}
model: Ropod (simulated)
software_version: "2026.11"

store:
  path: store
  quota: 2 GB
  rotate_s: 20

missions:
  - name: delivery
    start: >-
      sim_tasks.kind == 'delivery' and sim_tasks.event != 'finished' and
      sim_tasks.event != 'aborted'
    end: sim_tasks.event == 'finished' or sim_tasks.event == 'aborted'
    outcome: sim_tasks.event
    parameters: {{to: sim_tasks.location, task: sim_tasks.task_id}}
    max: 45 s

triggers:
  - name: bus_trouble
    when: "sim_bus.working_counter < 12"
    before: 3 s
    after: 3 s
"""
_BLACK_BOX = """\
- sim:
    robot: {id}
    seed: {seed}
    speed: max
    duration_s: {seconds}
    scenario: shuttle
    faults: {faults}
"""


@dataclass(frozen=True)
class Plan:
    """A robot: its seed, for how long it drives, what breaks, and where it belongs."""

    id: str
    seed: int
    seconds: int
    faults: str
    groups: tuple[str, ...]


PLANS = (
    Plan(
        "ropod_001", 7, 50,
        "[{id: wheel_front_left_bus_disconnected, at_s: 18, until_s: 24}, "
        "{id: laser_rear_motor_slow, at_s: 30}]",
        ("ward",),
    ),
    Plan("ropod_002", 11, 12, "[{id: localisation_crash, at_s: 4}]", ("kitchen",)),
)  # fmt: skip
NEVER = Plan("ropod_003", 1, 0, "[]", ("ward", "kitchen"))
"""A robot that nobody ever heard of."""


def wait_for(done: Callable[[], bool], what: str, patience_s: float = PATIENCE_S) -> None:
    """Wait until something that another process does has happened."""
    ends = time.monotonic() + patience_s
    while not done():
        if time.monotonic() > ends:
            raise TimeoutError(f"waited {patience_s:.0f} s in vain for: {what}")
        time.sleep(_POLL_S)


def tell(book: Book, name: str, done: Completed) -> Completed:
    """Write a command with what it printed and its exit status."""
    book.count += 1
    words = " ".join(map(str, done.args))
    parts = [words, f"exit {done.code}", "== stdout", done.stdout.decode("utf-8", "replace"),
             "== stderr", done.stderr.decode("utf-8", "replace")]  # fmt: skip
    book.write("cli", name, "\n".join(parts))
    return done


def make_robots(side: Side, book: Book) -> dict[str, Path]:
    """Make robot folders, record them, watch what was recorded; return the folders."""
    return {plan.id: _robot(side, book, plan) for plan in PLANS}


def _folder(side: Side, plan: Plan, room: str) -> tuple[Path, Completed]:
    folder = side.scratch / room / plan.id
    folder.parent.mkdir(parents=True, exist_ok=True)
    done = side.run(["new", folder])
    (folder / "robot.yaml").write_text(_ROBOT.format(id=plan.id))
    (folder / "black_box.yaml").write_text(
        _BLACK_BOX.format(id=plan.id, seed=plan.seed, seconds=plan.seconds, faults=plan.faults)
    )
    return folder, done


def _robot(side: Side, book: Book, plan: Plan) -> Path:
    """Record on virtual time, and import that in order: a recorder's files end where it likes."""
    maker, made = _folder(side, plan, "makers")
    tell(book, f"new_{plan.id}", made)
    folder, _ = _folder(side, plan, "robots")
    recording, ordered = (
        side.scratch / f"{plan.id}-as-it-came.mcap",
        side.scratch / f"{plan.id}.mcap",
    )
    steps: tuple[list[str | Path], ...] = (
        ["record", maker, "--quiet"],
        ["export", maker, "-o", recording, "--format", "mcap"],
    )
    for words in steps:
        if (done := side.run(words)).code != 0:
            raise RuntimeError(f"{words[0]} ended with {done.code}: {done.stderr!r}")
    put_in_order(recording, ordered)
    tell(
        book,
        f"import_{plan.id}",
        side.run(["import", ordered, "--store", folder / "store", "--json"]),
    )
    _watch(side, folder, plan)
    tell(book, f"detect_{plan.id}", side.run(["mission", "detect", folder]))
    mark: list[str | Path] = [
        "incident",
        "mark",
        folder,
        "--before",
        "10s",
        "--reason",
        "by hand",
        "--who",
        "anna",
    ]
    tell(book, f"mark_{plan.id}", side.run(mark, now_ns=DRIVE_NS + (plan.seconds - 2) * NS))
    return folder


def put_in_order(source: Path, target: Path) -> None:
    """Write the messages of an MCAP file anew, by time and topic, so that its bytes are fixed."""
    with source.open("rb") as file, target.open("wb") as out:
        reader = mcap.reader.make_reader(file)
        messages = [
            (m.log_time, c.topic, m.sequence, s, c, m) for s, c, m in reader.iter_messages()
        ]
        messages.sort(key=lambda found: found[:3])
        writer = mcap.writer.Writer(out)
        writer.start(profile="", library="oracle")
        channels: dict[str, int] = {}
        known = {channel.topic: (schema, channel) for _, _, _, schema, channel, _ in messages}
        for topic, (schema, channel) in sorted(known.items()):
            assert schema is not None
            number = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[topic] = writer.register_channel(
                topic, channel.message_encoding, number, dict(sorted(channel.metadata.items()))
            )
        for number, (at_ns, topic, _, _, _, message) in enumerate(messages):
            writer.add_message(channels[topic], at_ns, message.data, message.publish_time, number)
        writer.finish()  # type: ignore[no-untyped-call]  # the library leaves it untyped


def _watch(side: Side, folder: Path, plan: Plan) -> None:
    """Let a watcher write what it concludes, and end it before it finds the recorder silent."""
    wanted = b'"measured_ns":%d,' % (DRIVE_NS + (plan.seconds - 1) * NS)
    watcher = side.start(["watch", folder, "--json"])
    wait_for(
        lambda: wanted in watcher.stdout.read_bytes() or watcher.process.poll() is not None,
        f"the watcher of {folder.name}",
    )
    size = -1
    while size != (size := watcher.stdout.stat().st_size):  # it says the rest of that moment
        time.sleep(_QUIET_S)
    code = watcher.stop()
    if code != 0:
        raise RuntimeError(f"the watcher ended with {code}: {watcher.stderr.read_text()}")


def link(side: Side, book: Book, admin: Person, folder: Path, line: str) -> None:
    """Join a robot to the server, and link it until the server holds all its journals."""
    robot = folder.name
    tell(book, f"join_{robot}", side.run(["join", folder, "-"], stdin=line.encode() + b"\n"))
    linked = side.start(["link", folder])
    here = f"/api/v1/robots/{robot}"

    seen: list[object] = [None]

    def is_there() -> bool:
        if linked.process.poll() is not None:
            raise RuntimeError(f"the link ended: {linked.stderr.read_text()}")
        card = admin.ask("GET", here).json()
        seen[:] = [states_of(admin, robot), card["backlog_rows"], card["backlog_bytes"]]
        return (
            card["online"] is True
            and bool(seen[0])
            and "copying" not in str(seen[0])
            and seen[1:] == [0, 0]
        )

    try:
        wait_for(is_there, f"the journals of {robot}")
    except TimeoutError as error:
        raise RuntimeError(f"{error}; seen last: {seen}") from error
    linked.stop()
    wait_for(lambda: admin.ask("GET", here).json()["online"] is False, f"the end of {robot}'s link")


def states_of(admin: Person, robot: str) -> list[str]:
    """Return where the server has each journal of a robot."""
    found = admin.ask("GET", f"/api/v1/robots/{robot}/recordings").json()
    rows = (
        found if isinstance(found, list) else next(v for v in found.values() if isinstance(v, list))
    )
    return [str(one["state"]) for one in rows]
