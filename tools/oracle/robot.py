"""What is captured on the robot's side: recordings, what is concluded of them, every verb."""

from __future__ import annotations

import re
import shutil
import signal
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from tools.oracle.book import Book
from tools.oracle.side import NOW_NS, NS, Side

_ROBOT = """\
id: rob
model: test robot
store: {path: store, queue: 500 MB, rotate_s: 10, write_s: 30, sync_s: 60, reserve: 1 MB}
missions:
  - name: delivery
    start: sim_tasks.event == 'started'
    end: sim_tasks.event == 'finished' or sim_tasks.event == 'aborted'
    outcome: sim_tasks.event
    parameters: {to: sim_tasks.location, cart: sim_tasks.cart}
    max: 45 s
triggers:
  - name: hard_work
    when: sim_battery.current < -6 for 200ms
    before: 3 s
    after: 2 s
    reason: much current
  - name: end_of_source
    event: source_*
"""


@dataclass(frozen=True)
class Mission:
    """A simulated mission on virtual time: what breaks in it."""

    seed: int
    faults: str
    seconds: int = 25
    scenario: str = "transport"


MISSIONS: Mapping[str, Mission] = {
    "wheel": Mission(7, "{id: wheel_front_left_motor_weak, at_s: 8, magnitude: 0.6}"),
    "bus": Mission(3, "{id: wheel_rear_right_bus_plug_loose, at_s: 9}"),
    "laser": Mission(11, "{id: laser_front_blocked, at_s: 7, magnitude: 60, until_s: 17}"),
    "battery": Mission(5, "{id: wifi_weak, at_s: 5}, {id: load_loose, at_s: 12}", 20, "shuttle"),
    "encoder": Mission(23, "{id: wheel_rear_left_encoder_stuck, at_s: 6}", 20),
    "healthy": Mission(1, "", 15, "standing"),
}


def _folder(side: Side, mission: Mission, name: str = "rob") -> Path:
    """Make a robot folder with all monitors that records one simulated mission."""
    folder = side.scratch / name
    made = side.run(["new", folder])
    if made.code:
        raise RuntimeError(f"amberbox new failed: {made.stderr.decode()}")
    (folder / "robot.yaml").write_text(_ROBOT)
    (folder / "black_box.yaml").write_text(
        f"- sim:\n    seed: {mission.seed}\n    speed: max\n    duration_s: {mission.seconds}\n"
        f"    scenario: {mission.scenario}\n    faults: [{mission.faults}]\n"
    )
    return folder


def _recorded(side: Side, name: str = "wheel") -> Path:
    folder = _folder(side, MISSIONS[name])
    side.run(["record", folder, "--quiet"], ordered=True)
    return folder


def _inputs(side: Side) -> Path:
    """Return the foreign files, copied into the scratch folder."""
    folder = side.scratch / "in"
    shutil.copytree(side.scratch.parent / "inputs", folder, dirs_exist_ok=True)
    return folder


def mission(name: str) -> Callable[[Side, Book], None]:
    """Return the part that records one mission and asks what is concluded of it."""

    def part(side: Side, book: Book) -> None:
        folder = _folder(side, MISSIONS[name])
        book.run("record", folder, "--quiet", ordered=True)
        book.files(folder / "store")
        book.run("watch", folder, "--replay", "--json")
        book.run("diagnose", folder, "--json")
        book.run("events", folder, "--json")
        book.run("gaps", folder, "--json")
        book.run("mission", "detect", folder)
        book.run("mission", "list", folder, "--json")

    return part


def judged(side: Side, book: Book) -> None:
    """Ask all that judges: watch, status, diagnose in every form, rules, fault trees."""
    folder = _recorded(side)
    book.run("watch", folder, "--once")
    book.run("watch", folder, "--replay", "--from", "2026-01-05T08:00:05Z", "--to", "-5s")
    book.run("watch", folder, "--replay", "--speed", "0")
    book.run("diagnose", folder)
    book.run("diagnose", folder, "--engine", "faulttree", "--json")
    book.run("diagnose", folder, "--engine", "rules")
    book.run("diagnose", folder, "--at", "2026-01-05T08:00:10Z", "--svg", "-")
    book.run("diagnose", folder, "--symptom", "wheel_front_left.pulls_harder=absent",
             "--symptom", "nothing_such")  # fmt: skip
    book.run("diagnose", folder, "--answer", "nothing=1")
    book.run("status", folder)
    book.run("alarm", folder)
    book.run("faulttree", folder, "--closest", "--json")
    asked = "status(Component, Level, From, To), Level \\== ok"
    book.run("rules", "--where", folder, "--ask", asked, "--json")
    book.run("rules", "--where", folder, "--ask", "broken(X)", "--why")
    book.run("rules", "--where", folder, "--ask", "failed_with(M, C)", "--why-not")


def queried(side: Side, book: Book) -> None:
    """Print rows of a record, with right and wrong times."""
    folder, run = _recorded(side, "healthy"), book.run
    run("query", folder, "sim_battery", "voltage", "current", "--to", "-10s")
    run("query", folder, "sim_battery", "--json", "--points", "7")
    run("query", folder, "sim_imu", "--points", "40", "--format", "csv", "angular_velocity/z")
    for first, last in (
        ("2026-01-05T08:00:03Z", "2026-01-05 08:00:05"), ("-5s", "-4.5s"), ("1767600002", "-20s"),
        ("2026-01-05T09:00:03+01:00", "-21 s"), ("now-59m50s", "now-59m45s"), ("tomorrow", "-1s"),
        ("-1s", "-5s"), ("08:00:01", "08:00:03"), ("-1.5min", "-3 lightyears"),
    ):  # fmt: skip
        run("query", folder, "sim_host", "--from", first, "--to", last, "--format", "csv")


def asked(side: Side, book: Book) -> None:
    """Ask a record: items, columns, sql, gaps, events, plot, verify, incidents, missions."""
    folder = _recorded(side)
    run = book.run
    for verb in ("items", "gaps", "events", "verify", "mission"):
        run(verb, *(["list"] if verb == "mission" else []), folder)
    for verb in ("items", "gaps", "events", "verify"):
        run(verb, folder, "--json")
    run("items", folder, "--all")
    run("verify", folder, "--head", "0123456789abcdef", "--strict")
    run("query", folder, "sim_scan_front", "ranges", "--to", "-10s")
    run("query", folder, "sim_scan_front", "ranges[17]", "ranges[-1]", "received", "seq",
        "--from", "-1s", "--format", "csv", "--by", "timestamp")  # fmt: skip
    run("query", folder, "sim_wheels", "nothing")
    run("query", folder, "sim_weels")
    run("query", folder, "sim_odom", "position")
    run("query", folder, "sim_odom", "x", "--mission", "last:2", "--incident", "last")
    run("query", folder, "sim_tasks", "-o", "tasks.csv")
    run("query", folder, "sim_tasks", "-o", "tasks.parquet")
    run("query", folder, "sim_tasks", "-o", "tasks.nothing")
    for question, form in (
        ("select count(*) n, avg(voltage) v, min(timestamp) t from sim_battery", "table"),
        ("select * from sim_tasks", "json"),
        ("select time_bucket(interval 5 seconds, timestamp) b, max(percentage) "
         "from sim_battery group by 1 order by 1", "csv"),
        ("select unnest(ranges[1:3]) from sim_scan_rear limit 6", "csv"),
        ("select nothing from sim_battery", "table"), ("selec 1", "table"),
        ("drop view sim_battery", "table"), ("select * from read_csv('/etc/passwd')", "table"),
    ):  # fmt: skip
        run("sql", folder, question, "--format", form)
    for ending in ("svg", "html", "png", "gif"):
        run("plot", folder, "sim_battery", "voltage", "current", "-o", f"plot.{ending}",
            "--points", "30")  # fmt: skip
    book.files(*(side.scratch / name for name in ("tasks.csv", "tasks.parquet", "plot.svg",
                                                  "plot.html", "plot.png")))  # fmt: skip
    run("query", side.scratch / "nowhere", "x")
    run("incident", folder, "--reason", "by hand", "--before", "4s", "--after", "1s", "--json")
    run("incident", "list", folder)
    found = side.run(["incident", "list", folder, "--json"])
    for one in re.findall(rb'"id": "([^"]+)"', found.stdout):
        run("incident", "show", folder, one.decode())
        run("query", folder, "sim_host", "--incident", one.decode(), "--format", "csv")
        run("incident", "release", folder, one.decode())
    run("incident", "show", folder, "nothing")
    run("mission", "start", folder, "by_hand")
    run("mission", "end", folder, "--outcome", "done", now_ns=NOW_NS + 5 * NS)
    run("mission", "list", folder, "--json")
    run("query", folder, "sim_host", "--mission", "last", "--format", "csv")
    book.files(folder / "store")


def exported(side: Side, book: Book) -> None:
    """Export in every format, of a simulated and of a ROS record."""
    folder = _recorded(side, "battery")
    source = _inputs(side)
    side.run(["import", "--store", "ros", source / "drive.bag"])
    names = {"csv": "csv", "parquet": "pq", "mcap": "a.mcap", "mcap-json": "b.mcap"}
    for form, target in names.items():
        book.run("export", folder, "--format", form, "-o", target, "--from", "-8s", "--received")
        book.files(side.scratch / target)
    for form, target in {**names, "bag": "c.bag"}.items():
        book.run("export", "ros", "--format", form, "-o", f"ros-{target}", "--with-box")
        book.files(side.scratch / f"ros-{target}")
    for pack in ("bz2", "lz4"):
        book.run("export", "ros", "-o", f"{pack}.bag", "--compression", pack, "--json")
        book.files(side.scratch / f"{pack}.bag")
    book.run("export", folder, "--item", "sim_tasks", "--to", "-1s")
    book.run("export", folder, "--variable", "sim_battery.voltage", "--format", "csv",
             "--by", "timestamp")  # fmt: skip
    book.run("export", folder, "-o", "c.bag")
    book.run("export", folder, "-o", "x.nothing")
    book.run("export", folder, "--item", "sim_task", "-o", "y.mcap")
    book.run("export", folder, "--format", "journals", "-o", "z")
    book.run("export", folder, "-o", "csv")


def imported(side: Side, book: Book) -> None:
    """Import every foreign format; segments and manifest are made on the way."""
    source = _inputs(side)
    folder = _recorded(side, "encoder")
    side.run(["export", folder, "--format", "mcap", "-o", "rob.mcap"])
    book.run("import", "--store", "store", source / "drive.bag", source / "drive_ros2",
             source / "drive.csv", source / "flight.ulg", "--json")  # fmt: skip
    book.run("import", "--store", "store", source / "dump")
    book.run("import", "--store", "store", source / "drive.csv")
    book.run("import", "--store", "store", "rob.mcap", "--topics", "battery", "host", "wheels",
             "imu", "scan_front", "nothing")  # fmt: skip
    book.files(side.scratch / "store")
    for item in ("ros_cmd_vel", "ros_scan", "ulog_state_1", "drive", "zmq_base_error"):
        book.run("query", "store", item)
    book.run("items", "store")
    book.run("gaps", "store")
    book.run("events", "store")
    book.run("verify", "store", "--json")
    for name in ("broken.csv", "bad.mcap", "nothing.bag"):
        book.run("import", "--store", "other", source / name)
    book.run("import", "--store", "third", source / "stamps.csv", "--time", "t_s", "--start",
             "2026-01-05T08:00:00Z", "--source", "hand")  # fmt: skip
    book.run("import", "--store", "third", source / "stamps.csv", "--time", "nothing")
    book.run("query", "third", "hand_stamps")
    book.run("items", source / "flight.ulg")


def segments(side: Side, book: Book) -> None:
    """Import one recording after another until small segments are joined; damage the store."""
    folder = _recorded(side, "healthy")
    lengths = (1, 3, 5, 7, 9, 11, 13)
    for seconds in lengths:
        target = f"part-{seconds}.mcap"
        side.run(["export", folder, "--item", "sim_host", "--item", "sim_battery", "--item",
                  "sim_bus", "--from", f"-{seconds + 1}s", "--to", f"-{seconds}s",
                  "-o", target])  # fmt: skip
    for seconds in reversed(lengths):
        side.run(["import", "--store", "store", f"part-{seconds}.mcap"])
    store = side.scratch / "store"
    book.files(store)
    book.run("query", store, "sim_bus", "--format", "csv")
    book.run("verify", store)
    journal = sorted((store / "journal").glob("*.mcap"))[-1]
    data = bytearray(journal.read_bytes())
    data[len(data) // 2] ^= 1
    journal.write_bytes(data)
    (sorted((store / "segments").rglob("*.parquet"))[0]).write_bytes(b"PAR1")
    manifest = store / "manifest"
    manifest.write_bytes(manifest.read_bytes()[:-30])
    for verb in ("verify", "gaps", "items"):
        book.run(verb, store)
    book.run("query", store, "sim_host", "--format", "csv")
    book.run("verify", store, "--json")


def kept(side: Side, book: Book) -> None:
    """Let the recorder's keeper work: segments, missions, seals, then a quota that is too small."""
    folder = _folder(side, Mission(2, "", 55, "shuttle"))
    box = folder / "black_box.yaml"
    text = box.read_text()
    for run in range(4):
        box.write_text(f"{text}    start: 2026-01-05T08:0{run}:00Z\n")
        side.run(["record", folder, "--quiet"], ordered=True)
    box.write_text("- sim:\n    seed: 1\n    scenario: standing\n    topics: [{name: tasks}]\n")
    _keep(side, folder, '"kind":"names"')
    book.files(folder / "store", but=("*/keep/*", "*/journal/000005-*", "*/manifest", "*/room",
                                      "*/head", "*/heads.json", "*/incidents/*"))  # fmt: skip
    for verb in ("events", "gaps", "items"):
        book.run(verb, folder)
    book.run("mission", "list", folder, "--json")
    robot = folder / "robot.yaml"
    robot.write_text(robot.read_text().replace("reserve: 1 MB", "quota: 10 MB, keep_min: 1s"))
    _keep(side, folder, '"kind":"gone"')
    book.run("gaps", folder)
    book.run("items", folder)
    tombstones = re.findall(r'"kind":"gone","entry":(\{.*?\})', _text(folder / "store/manifest"))
    book.text("tombstones.json", "\n".join(tombstones))


def _keep(side: Side, folder: Path, word: str, patience_s: float = 60, calm_s: float = 3) -> None:
    """Record until the keeper has written a word into the manifest and then no more for a while.

    The recorder is killed: what it would write at its end depends on when that comes.
    """
    manifest = folder / "store" / "manifest"
    before = b""
    running = side.start(["record", folder, "--quiet"])
    calm_since_s = began_s = time.monotonic()
    while time.monotonic() < began_s + patience_s:
        now_s, data = time.monotonic(), manifest.read_bytes() if manifest.exists() else b""
        if data != before:
            before, calm_since_s = data, now_s
        if word.encode() in data and now_s - calm_since_s > calm_s:
            break
        time.sleep(0.1)
    running.stop(signal.SIGKILL)


def _text(path: Path) -> str:
    return path.read_text(errors="replace")


def folders(side: Side, book: Book) -> None:
    """Make robot folders and judge them, good and bad; all that needs a folder only."""
    source = _inputs(side)
    run = book.run
    for kind in ("sim", "zmq", "ros", "power", "recording", "status", "zmp"):
        run("new", f"new-{kind}", "--from", kind)
        run("check", f"new-{kind}")
    run("new", "new-sim")
    run("new", "new-json", "--json")
    book.files(side.scratch / "new-sim")
    run("check", "new-sim", "--modes")
    run("check", "new-sim", "--json")
    for bad in sorted((source / "folders").iterdir()):
        run("check", bad)
    run("check", "nowhere")
    run("record", source / "folders" / "unknown_key")
    run("watch", source / "folders" / "bad_components", "--once")
    for action in ("check", "table", "criticality", "coverage"):
        run("fmea", action, "new-sim")
        run("fmea", action, "new-sim", "--json")
    run("fmea", "table", "new-sim", "--csv", "-")
    run("fmea", "tabel", "new-sim")
    run("fmea", "criticality", "new-sim", "--exposure", "100")
    run("faulttree", "new-sim")
    run("faulttree", "new-sim", "--effect", "push", "--importance", "--cut-sets", "5")
    run("faulttree", "new-sim", "--effect", "push", "--json", "--exposure", "100")
    run("faulttree", "new-sim", "--effect", "move", "--order", "2", "--export", "move.xml")
    run("faulttree", "new-sim", "--effect", "moove")
    run("faulttree", source / "tree.xml", "--importance", "--cut-sets", "9", "--json")
    run("faulttree", source / "tree.xml", "--order", "1")
    run("faulttree", source / "bad.xml")
    run("faulttree", source / "tree.xml", "--nodes", "2")
    run("doctor", "new-sim")
    run("install-service", "new-sim", "--user", "oracle")
    run("join", "new-sim", "nonsense")
    run("link", "new-sim")
    run("run", source / "folders" / "no_files")
    book.files(side.scratch / "move.xml")


def rules(side: Side, book: Book) -> None:
    """Ask rules of a file: answers, proofs, failures, export, mistakes."""
    source = _inputs(side)
    file = source / "rules.pl"
    run = book.run
    run("rules", file)
    for goal in ("broken(X)", "beside(m1, X)", "sound(X)", "sum(N)", "near(X)", "half(Y)",
                 "motor(X), \\+ hot(X)", "nothing(X)", "broken(", "X is 1/0",
                 "member(X, [a,b]), X == b"):  # fmt: skip
        run("rules", file, "--ask", goal, "--why")
        run("rules", file, "--ask", goal, "--json")
    run("rules", file, "--ask", "broken(m2)", "--why-not")
    run("rules", file, "--ask", "beside(X, m1)", "--why-not", "--json")
    run("rules", file, "--ask", "beside(X, Y)", "--steps", "3")
    run("rules", file, "--export", "out.pl")
    run("rules", source / "bad.pl")
    run("rules", "nowhere.pl")
    book.files(side.scratch / "out.pl")


def plugins(side: Side, book: Book) -> None:
    """Show all plugins, and each with its sample and keys; probe once what all machines have."""
    book.run("plugins")
    listed = book.run("plugins", "--json")
    for kind in ("source", "mode", "probe", "sauce"):
        book.run("plugins", "--kind", kind)
    for name in sorted(set(re.findall(rb'"name": "([^"]+)"', listed.stdout))):
        book.run("plugins", name.decode())
    book.run("plugins", "battry")
    book.run("probe", "--list")
    probed = side.scratch / "there"
    probed.write_text("x")
    for probe in (("path_exists", probed), ("path_exists", "nowhere"), ("nothing", "x"),
                  ("process", "no_such_program")):  # fmt: skip
        book.run("probe", "--once", "--probe", *probe)


VERBS = (
    "new", "check", "record", "watch", "run", "status", "query", "plot", "incident", "diagnose",
    "serve", "alarm", "demo", "doctor", "events", "export", "faulttree", "fetch", "fmea",
    "foxglove", "gaps", "import", "install-service", "items", "join", "link", "mission",
    "plugins", "probe", "rules", "sign-in", "sign-out", "sql", "verify",
)  # fmt: skip


def helps(side: Side, book: Book) -> None:
    """Show all help texts."""
    book.run("--help")
    book.run("--version")
    book.run()
    for verb in VERBS:
        book.run(verb, "--help")
    for action in ("list", "start", "end", "detect"):
        book.run("mission", action, "--help")
    for action in ("cert", "add-robot", "add-user", "clock"):
        book.run("serve", action, "--help")


def mistakes(side: Side, book: Book) -> None:
    """Call every verb with nothing, with an unknown option, and for a place that is not there."""
    book.run("chekc")
    book.run("--nothing")
    for verb in VERBS:
        if verb != "demo":
            book.run(verb)
        book.run(verb, "--nothing", "x")
    for verb in ("items", "events", "gaps", "verify", "status", "alarm", "watch", "doctor",
                 "diagnose", "export"):  # fmt: skip
        book.run(verb, side.scratch / "nowhere")
    book.run("items", "https://127.0.0.1:9/robots/r")
    book.run("fetch", "nowhere")


_API = """\
import amberbox, json, sys
import numpy as np
record = amberbox.open(sys.argv[1])
table = record.query("sim_battery", ["voltage", "percentage"], from_="-6s")
print(len(table), [(c.name, c.type, c.unit) for c in table.fields])
for name, column in table.columns.items():
    print(name, np.asarray(column).tolist()[:20])
print([(item.name, item.rows) for item in record.items()])
print(record.events().columns["kind"].tolist())
print([str(gap)[:300] for gap in record.gaps()][:5])
print(amberbox.__version__)
rows = {}
for batch in amberbox.follow(sys.argv[1]):
    rows[batch.item] = rows.get(batch.item, 0) + len(batch.log_time_ns)
    if batch.item == "sim_imu" and rows[batch.item] >= 100:
        break
print(sorted(rows))
try:
    record.query("sim_batery")
except Exception as error:
    print(type(error).__name__, error)
"""


def api(side: Side, book: Book) -> None:
    """Use the documented Python interface."""
    folder = _recorded(side, "healthy")
    book.note(side.run(["-c", _API, folder], module=""), "api")


PARTS: Mapping[str, Callable[[Side, Book], None]] = {
    "helps": helps,
    "mistakes": mistakes,
    "plugins": plugins,
    "rules": rules,
    "folders": folders,
    "queried": queried,
    "asked": asked,
    "judged": judged,
    "exported": exported,
    "imported": imported,
    "segments": segments,
    "kept": kept,
    "api": api,
    **{f"mission-{name}": mission(name) for name in MISSIONS},
}
