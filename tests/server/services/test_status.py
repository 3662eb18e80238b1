"""API, pages, metrics and command line agree on robots, whatever happens to these."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st
from starlette.testclient import TestClient

from amberbox.cli import status as status_verb
from amberbox.client import models
from amberbox.core.robot_status import NOTHING_WRONG, USE, WORDS, use_text
from amberbox.core.types import AmbiguityGroup, Diagnosis, Hypothesis, Symptom
from amberbox.link.frames import LinkRow
from amberbox.monitoring.findings import encoded
from amberbox.server.bus import ServerChange
from amberbox.server.ingest import link_state
from amberbox.server.schema import ALARM
from amberbox.server.web.text import catalogue
from tests.fuzzing import examples, fuzz
from tests.server.house import ROBOTS, House, house
from tests.server.state import lives

NAMES = sorted(ROBOTS)[:2]
FAULT = "laser/device/working"
LEVELS = ["ok", "warn", "error", "stale", "unknown"]
ROBOT = st.sampled_from(NAMES)
PHASES = (Phase.explicit, Phase.reuse, Phase.generate)
"""Without shrinking: an example requests a dozen pages."""
Event = tuple[Any, ...]
EVENTS: st.SearchStrategy[Event] = st.one_of(
    st.tuples(st.sampled_from(["hello", "lost", "silent", "broken", "healed", "mended"]), ROBOT),
    st.tuples(st.just("says"), ROBOT, st.sampled_from(LEVELS)),
    st.tuples(st.just("alarm"), ROBOT, st.sampled_from(["warning", "urgent", "critical", "fatal"])),
    st.tuples(st.just("effect"), ROBOT, st.sampled_from(["", "urgent", "critical"])),
    st.tuples(st.sampled_from(["acknowledged", "over", "restart"])),
    st.tuples(st.just("time"), st.sampled_from([1, 6, 30, 3600])),
)


class World:
    """A server and what happens to its robots."""

    def __init__(self, home: House) -> None:
        self.home = home
        self.alarms = 0
        self.seq = 0
        self._load()

    def sign_in(self) -> None:
        """Sign a person in: earlier sessions may have ended."""
        self.viewer: TestClient = self.home.client("admin")

    def happen(self, event: Event) -> None:
        """Let one thing happen."""
        what, *about = event
        getattr(self, f"_{what}")(*about)

    def _load(self) -> None:
        for robot in NAMES:
            self.home.services.feed.state._load(robot)

    def _hello(self, robot: str) -> None:
        lives.connect(self.home, robot)
        self._says(robot, "ok")

    def _lost(self, robot: str) -> None:
        if self.home.services.links.robots.pop(robot, None):
            with self.home.services.database.begin() as connection:
                link_state.record_disconnect(connection, robot, 1, self.home.clock.wall_ns())

    def _silent(self, robot: str) -> None:
        if robot in self.home.services.links.robots:
            self.home.services.links.robots[robot].last_received_s = float("-inf")

    def _says(self, robot: str, level: str) -> None:
        if robot in self.home.services.links.robots:
            now_ns = self.home.clock.wall_ns()
            for component, how in (("laser", level), ("navigation", "ok")):
                status = lives.status(component, how, now_ns, reason=f"it is {how}")
                self._row(robot, lives.STATUS, status)
            unmonitored = lives.status("arm", "unknown", now_ns, state="not_monitored")
            self._row(robot, lives.STATUS, unmonitored)

    def _broken(self, robot: str) -> None:
        self._find(robot, self._symptom("present"), self._diagnosis(robot, "open"))

    def _healed(self, robot: str) -> None:
        self._find(robot, self._symptom("absent"), self._diagnosis(robot, "healed"))

    def _mended(self, robot: str) -> None:
        """Nothing of the fault is seen any more, and the diagnosis is still open."""
        self._find(robot, self._symptom("absent"))

    def _effect(self, robot: str, severity: str) -> None:
        told = {"explanation": {"use": {"severity": severity}}, "id": f"{robot}-1", "revision": 1}
        self.home.services.feed.state._explained(ServerChange("explained", robot, {"answer": told}))

    def _alarm(self, robot: str, severity: Any) -> None:
        self.alarms += 1
        lives.put_alarm(self.home, self.alarms, robot, severity=severity)

    def _acknowledged(self) -> None:
        self._change(state="acknowledged", acknowledged_by="operator")

    def _over(self) -> None:
        self._change(active=False, cleared_ns=self.home.clock.wall_ns())

    def _change(self, **changes: Any) -> None:
        with self.home.services.database.begin() as connection:
            connection.execute(ALARM.update().where(ALARM.c.number == self.alarms), [changes])

    def _time(self, seconds: int) -> None:
        self.home.clock.advance(seconds)

    def _restart(self) -> None:
        """Restart the server: its memory is lost, and it reads the past again."""
        services = self.home.services
        services.links.robots.clear()
        with services.database.begin() as connection:
            link_state.reset_connections(connection)
        latest = services.feed.state.latest
        with latest._lock:
            latest._known.clear()
        self._load()

    def _symptom(self, state: Any) -> Symptom:
        now_ns = self.home.clock.wall_ns()
        return Symptom(FAULT, state, FAULT, now_ns if state == "present" else None, now_ns)

    def _diagnosis(self, robot: str, state: Any) -> Diagnosis:
        one = Hypothesis("h1", frozenset({"laser#dead"}), 0.9)
        return Diagnosis(
            f"{robot}-1", 1, robot, self.home.clock.wall_ns(), lives.HASH, (one,), 1.0,
            groups=(AmbiguityGroup(("h1",), 0.9),), symptoms=(FAULT,), state=state,
        )  # fmt: skip

    def _find(self, robot: str, *found: Symptom | Diagnosis) -> None:
        for one in found if robot in self.home.services.links.robots else ():
            channel, data = encoded(one)
            self._row(robot, channel, msgspec.json.decode(data))

    def _row(self, robot: str, channel: str, values: Any) -> None:
        self.seq += 1
        now_ns = self.home.clock.wall_ns()
        row: LinkRow = lives.say(self.home, robot, channel, now_ns, self.seq, values)
        change = ServerChange("rows", robot, {"store_id": "s", "rows": [row]})
        self.home.services.feed.state._rows(change)

    def read(self, path: str) -> str:
        """Return the body of an answer that has to be there."""
        answer = self.viewer.get(path)
        assert answer.status_code == 200, (path, answer.text[-2000:])
        return str(answer.text)


def words(markup: str) -> str:
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", markup)).split())


def attribute(markup: str, name: str) -> str:
    found = re.search(rf'{name}="([^"]*)"', markup)
    assert found, name
    return html.unescape(found[1])


def agree(world: World) -> None:
    """Ask everybody, and compare the answers."""
    cards = {card["robot"]: card for card in json.loads(world.read("/api/v1/robots"))}
    levels = [card["status"]["level"] for card in cards.values()]
    in_order = sorted(cards, key=lambda robot: (-cards[robot]["status"]["rank"], robot))
    fleet = world.read("/")
    shown = re.findall(r'<article class="card robot-card" data-robot="(\w+)" data-level="(\w+)"',
                       fleet)  # fmt: skip
    assert shown == [(robot, cards[robot]["status"]["level"]) for robot in in_order]
    metrics = world.read("/api/v1/metrics")
    for level in LEVELS:
        counted = f'amberbox_robots_by_level{{level="{level}"}} {levels.count(level)}'
        assert counted in metrics, (counted, levels)
    listed = [status_verb._FleetRobot(known, status_verb._fleet_status(known))
              for known in msgspec.convert([*cards.values()], list[models.Card])]  # fmt: skip
    listed.sort(key=lambda one: (-one.status.rank, one.card.robot))
    assert [one.card.robot for one in listed] == in_order
    assert status_verb._fleet_verdict(listed) == any(
        level not in ("ok", "warn") for level in levels
    )
    numbers_agree(world, cards, fleet)
    for robot, line in zip(in_order, [*status_verb._fleet_lines(listed)][2:], strict=True):
        assert line.split()[:2] == [robot, WORDS[cards[robot]["status"]["level"]]]
    for robot in NAMES:
        of_robot(world, cards[robot])


def numbers_agree(world: World, cards: Any, fleet: str) -> None:
    """Compare the numbers of alarms, each of which is of one robot here."""
    count = sum(card["alarms"] for card in cards.values())
    assert attribute(fleet, "data-alarm-count") == str(count)
    listed = world.read("/pieces/alarms")
    assert len(re.findall(r'data-alarm="\d+"', listed)) == count
    assert re.search(rf'data-tab="open"[^>]*>[^<]*<b class="chip-count">{count}</b>', listed)
    top = re.search(r'<span class="nav-count([^"]*)"', fleet)
    lasting = any(card["alarms"] > card["alarms_over"] for card in cards.values())
    assert top and ("severity-" in top[1]) == lasting


def of_robot(world: World, card: Any) -> None:
    """Compare everything that is shown of one robot."""
    robot, status = card["robot"], card["status"]
    assert json.loads(world.read(f"/api/v1/robots/{robot}"))["status"] == status
    tree = json.loads(world.read(f"/api/v1/robots/{robot}/status"))
    assert tree["status"] == status and (tree["silence"] != "") == (not is_current(status))
    monitored = [one["condition"] for one in tree["components"] if one["condition"]]
    if is_current(status) and any(one["level"] == "error" for one in monitored):
        assert status["level"] == "error"
    page, diagnosis = world.read(f"/robots/{robot}"), world.read(f"/robots/{robot}/diagnosis")
    piece = world.read(f"/pieces/robots/{robot}")
    for markup in (page, diagnosis):
        head = markup[markup.index('id="robot-state"') :].partition("<nav")[0]
        assert attribute(head, "data-level") == status["level"]
        assert attribute(head, "data-rank") == str(status["rank"])
        assert attribute(head, "data-known") == ("yes" if is_current(status) else "no")
    for markup in (page, diagnosis, piece):
        said = words(markup)
        if status["level"] != "ok":
            assert NOTHING_WRONG not in said and "Nothing is known to be broken" not in said
        if is_current(status):
            assert "What was broken" not in said or "Nothing of this is seen since" in said
        else:
            assert "What is broken" not in said and "Can the robot be used?" not in said
    if re.search(r'class="card dx dx-open(?! dx-then)', page):
        assert is_current(status) and status["level"] != "ok"
        assert card["diagnosis"] is not None
    ages = re.findall(r'class="td age num" data-age[^>]*>(.*?)</span>', page)
    assert all(("<time" in age) == (not is_current(status)) for age in ages), ages


def is_current(status: Any) -> bool:
    return status["contact"] == "online" and status["monitoring"] in ("running", "overloaded")


def test_pages_have_the_words_of_the_one_status() -> None:
    text = catalogue().text
    assert {level: text(f"common.level.{level}") for level in WORDS} == WORDS
    for severity, use in USE.items():
        assert text(f"words.severity_{severity}.name") == use_text(severity)
        assert text(f"alarms.use.{severity}") == use


@fuzz
@given(st.lists(EVENTS, max_size=12))
@example([("hello", NAMES[0]), ("broken", NAMES[0]), ("effect", NAMES[0], "critical")])
@example(
    [
        ("hello", NAMES[0]),
        ("broken", NAMES[0]),
        ("mended", NAMES[0]),
        ("time", 6),
        ("says", NAMES[0], "ok"),
        ("time", 6),
        ("says", NAMES[0], "ok"),
    ]
)
@example([("hello", NAMES[1]), ("says", NAMES[1], "error"), ("alarm", NAMES[1], "fatal"),
          ("acknowledged",), ("lost", NAMES[1]), ("time", 30)])  # fmt: skip
@settings(max_examples=examples(2), phases=PHASES)
def test_no_two_answers_contradict_each_other(events: Sequence[Event]) -> None:
    with TemporaryDirectory() as folder, house(Path(folder) / "house", shared=True) as home:
        world = World(home)
        for event in events:
            world.happen(event)
        world.sign_in()
        agree(world)
