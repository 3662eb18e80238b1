"""What a server shows: people, robots with records, every route, page, socket, file, verb."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import shutil
import socket
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from tools.oracle import server_requests as asked
from tools.oracle.server_asking import NORMALISED, Book, Person
from tools.oracle.server_robots import NEVER, PLANS, link, make_robots, states_of, tell, wait_for
from tools.oracle.side import NOW_NS, NS, Running, Side

__all__ = ["NORMALISED", "capture"]
_PORT = 47811
_ENDS = ("done", "failed", "cancelled", "expired")
_PASSWORD = "a long enough passphrase"
_PEOPLE: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("admin", "admin", ()),
    ("viewer", "viewer", ()),
    ("operator", "operator", ()),
    ("technician", "technician", ()),
    ("nurse", "technician", ("ward",)),
    ("cook", "viewer", ("kitchen",)),
)
_LINK = re.compile(r'(?:href|src|data-\w+|action)="(/[^"#]*)')
_TABLE_ROLES = ("nobody", "viewer", "operator", "technician", "admin", "nurse", "cook", "token",
                "robot")  # fmt: skip


class Stand:
    """The server of a side with everybody who asks it."""

    def __init__(self, side: Side, out: Path) -> None:
        self.side, self.book = side, Book(out)
        self.clock = side.clock("server-clock")
        self.data = side.scratch / "server"
        self.people: dict[str, Person] = {}
        self.lines: dict[str, str] = {}
        self.links: set[str] = set()
        self.robots: dict[str, Path] = {}

    def serve(self, name: str, *words: str, stdin: bytes | None = None) -> None:
        """Run ``amberbox serve`` with a sub-command and write what it says."""
        done = self.side.run(["serve", *words, "--data", self.data], stdin=stdin)
        tell(self.book, f"serve_{name}", done)

    def prepare(self) -> None:
        """Add the first accounts, as long as no server runs."""
        self.serve("unknown", "nothing")
        self.serve("clock_without_server", "clock")
        self._add_people(few=False)
        self.serve("add_robot_too_early", "add-robot", "ropod_001")

    def fill(self) -> None:
        """Add robots and who is for some of them, beside the running server."""
        for plan in (*PLANS, NEVER):
            file = self.side.scratch / f"{plan.id}.line"
            groups = [word for group in plan.groups for word in ("--group", group)]
            self.serve(f"add_{plan.id}", "add-robot", plan.id, *groups, "--line-file", str(file))
            self.lines[plan.id] = file.read_text().strip()
        self._add_people(few=True)
        self.serve("add_twice", "add-user", "admin", stdin=_PASSWORD.encode() + b"\n")
        self.serve("add_weak", "add-user", "weak", stdin=b"123\n")
        self.serve("add_king", "add-user", "king", "--role", "king", stdin=b"x\n")
        self.serve("add_somebody", "add-user", "somebody", "--one-time")
        self.serve("add_robot_twice", "add-robot", "ropod_001")
        self.serve("group_alone", "--group", "ward")

    def _add_people(self, *, few: bool) -> None:
        for name, role, groups in _PEOPLE:
            if bool(groups) == few:
                words = [word for group in groups for word in ("--group", group)]
                self.serve(f"add_{name}", "add-user", name, "--role", role, *words,
                           stdin=_PASSWORD.encode() + b"\n")  # fmt: skip

    def begin(self) -> Running:
        """Start the server; return when it answers."""
        running = self.side.start(
            ["serve", "--data", self.data, "--port", str(_PORT)], clock=self.clock
        )

        def answers() -> bool:
            if running.process.poll() is not None:
                raise RuntimeError(f"the server ended: {running.stderr.read_text()}")
            return b"serving" in running.stdout.read_bytes()

        wait_for(answers, "the server")
        return running

    def enter(self) -> None:
        """Sign everybody in."""
        self.people["nobody"] = Person("nobody", _PORT, self.book)
        for name, _, _ in _PEOPLE:
            self.people[name] = person = Person(name, _PORT, self.book)
            person.sign_in(_PASSWORD)
        scopes = ["read:status", "read:alarms", "write:alarms", "read:data", "read:diagnoses",
                  "write:diagnoses", "write:incidents", "write:missions", "write:fetch",
                  "read:download", "read:audit", "read:metrics"]  # fmt: skip
        made = self.people["admin"].record(
            "api", "POST", "/api/v1/tokens", {"name": "all", "scopes": scopes}
        )
        secret = {"Authorization": f"Bearer {made.json()['token']}"}
        self.people["token"] = Person("token", _PORT, self.book, secret)
        key = self.lines["ropod_003"].partition("//")[2].partition("@")[0]
        self.people["robot"] = Person("robot", _PORT, self.book, {"Authorization": f"Robot {key}"})
        self.use_all()

    def use_all(self) -> None:
        """Ask once as everybody: when keys were used last must not change while lists are read."""
        for person in self.people.values():
            person.ask("GET", "/api/v1/robots")


def capture(side: Side, out: Path) -> None:
    """Write everything that a side's server shows into ``out``, a file for each exchange."""
    wait_for(_port_is_free, f"port {_PORT}, which both sides take")
    stand = Stand(side, out)
    began_s = time.monotonic()
    stand.robots = make_robots(side, stand.book)
    stand.prepare()
    running = stand.begin()
    stand.fill()
    stand.enter()
    for plan in PLANS:
        link(side, stand.book, stand.people["admin"], stand.robots[plan.id], stand.lines[plan.id])
    _settle(stand)
    stand.use_all()
    seconds = {"made": time.monotonic() - began_s}
    for part in (_routes, _pages, _questions, _feed, _changes, _downloads, _verbs, _statics):
        since_s = time.monotonic()
        try:
            part(stand)
        except Exception as error:
            stand.book.write("", f"failed_{part.__name__}", f"{type(error).__name__}: {error}")
            traceback.print_exc()
        seconds[part.__name__.strip("_")] = time.monotonic() - since_s
    _beside(stand, running)
    (side.scratch / "server-figures.json").write_text(
        json.dumps({"requests": stand.book.count, "seconds": seconds}, indent=1)
    )


def _settle(stand: Stand) -> None:
    """Wait until folder, alarms and diagnoses have been taken in."""
    admin = stand.people["admin"]
    stand.clock.advance_s(600)  # columns are made once a minute by the wall clock

    def is_taken_in() -> bool:
        for plan in PLANS:
            if set(states_of(admin, plan.id)) != {"in_columns"}:
                return False
            here = f"/api/v1/robots/{plan.id}"
            if (
                "note" in admin.ask("GET", f"{here}/status").json()
                and (admin.ask("GET", f"{here}/status").json()["note"])
            ):
                return False
            if not admin.ask("GET", f"/api/v1/alarms?robot={plan.id}").json():
                return False
        return True

    wait_for(is_taken_in, "alarms and folders")
    last = b""
    quiet = 0
    while quiet < 3:  # an alarm's cause follows it when the worker has explained the diagnosis
        now = b"".join(
            re.sub(rb'"age_s": ?[0-9.]+', b"", admin.ask("GET", path).body)
            for path in ("/api/v1/alarms", "/api/v1/robots", f"{asked.R}/diagnoses")
        )
        quiet = quiet + 1 if now == last else 0
        last = now
        time.sleep(0.3)


def _routes(stand: Stand) -> None:
    """Ask every route that the server describes, as everybody; note who gets through."""
    admin = stand.people["admin"]
    described = admin.record("api", "GET", "/api/v1/openapi.json").json()
    stand.book.write("", "openapi", json.dumps(described, indent=1, sort_keys=True))
    table = []
    for path, methods in sorted(described["paths"].items()):
        for method in sorted(methods):
            table.append((method.upper(), _filled(path, "ropod_001")))
    lines = _as_everybody(stand, [one for one in table if one[0] == "GET"], "api")
    for method, path in table:
        if method != "GET":
            lines.append(_refusals(stand, method, path))
    stand.book.write("", "roles_api", "\n".join(lines))


def _refusals(stand: Stand, method: str, path: str) -> str:
    """Ask for a change that cannot be made: of nothing, without a body, without CSRF token."""
    path = path.replace("ropod_001", "ropod_003").replace("/somebody", "/nothing")
    if path in ("/api/v1/session", "/api/v1/session/others") and method == "DELETE":
        return f"{method} {path} left out: it would end the sessions of who asks"
    if path.endswith("/keys") and method == "DELETE":
        path = path.replace("ropod_003", "nothing")
    found = []
    for role in _TABLE_ROLES:
        answer = stand.people[role].record("refused", method, path)
        found.append(f"{role}={answer.status}")
    bare = Person("admin without csrf", _PORT, stand.book,
                  {"Cookie": stand.people["admin"].headers["Cookie"]})  # fmt: skip
    found.append(f"bare={bare.record('refused', method, path).status}")
    foreign = {"Origin": "https://evil.example"}
    answer = stand.people["admin"].record("refused", method, path, b"{", foreign, "foreign")
    found.append(f"foreign={answer.status}")
    bare.close()
    return f"{method} {path} {' '.join(found)}"


def _as_everybody(stand: Stand, table: list[tuple[str, str]], room: str) -> list[str]:
    """Ask each path as each role, roles beside each other; return a line for each path."""

    def ask_all(role: str) -> list[int]:
        person = stand.people[role].copy()
        try:
            answers = [person.ask(method, path) for method, path in table]
        finally:
            person.close()
        kept[role] = answers
        return [answer.status for answer in answers]

    kept: dict[str, list[Any]] = {}
    with ThreadPoolExecutor(4) as threads:
        statuses = dict(zip(_TABLE_ROLES, threads.map(ask_all, _TABLE_ROLES), strict=True))
    for role in _TABLE_ROLES:
        for (method, path), answer in zip(table, kept[role], strict=True):
            said = f"{method} {path} as {role}"
            stand.book.exchange(room, f"{method}_{path}_{role}", said, answer)
            if "html" in answer.header("content-type"):
                stand.links.update(_LINK.findall(answer.body.decode("utf-8", "replace")))
    return [
        f"{method} {path} " + " ".join(f"{role}={statuses[role][number]}" for role in _TABLE_ROLES)
        for number, (method, path) in enumerate(table)
    ]


def _pages(stand: Stand) -> None:
    """Ask for every page as everybody."""
    paths = [("GET", path.replace("{robot}", "ropod_001")) for path in asked.PAGES]
    lines = _as_everybody(stand, paths, "pages")
    stand.book.write("", "roles_pages", "\n".join(lines))
    for path in asked.PAGES:
        if "{robot}" in path:
            for robot in ("ropod_002", "ropod_003", "nothing"):
                stand.people["technician"].record("pages", "GET", path.replace("{robot}", robot))
    known = sorted(re.sub(r"\?.*", "?", stand.book.clean(link)) for link in stand.links)
    stand.book.write("", "links", "\n".join(dict.fromkeys(known)))


def _questions(stand: Stand) -> None:
    """Ask with arguments that fit and with wrong ones."""
    stand.people["technician"].ask("GET", "/")
    for path in asked.GETS:
        answer = stand.people["technician"].record("questions", "GET", path)
        if answer.status == 403:
            stand.people["admin"].record("questions", "GET", path)
    technician = stand.people["technician"]
    for one in technician.ask("GET", f"{asked.R}/diagnoses").json():
        technician.record("questions", "GET", f"{asked.R}/diagnoses/{one['id']}")
        technician.record("questions", "GET", f"/robots/ropod_001/diagnosis?id={one['id']}")
    folder = technician.ask("GET", f"{asked.R}/folder").json()
    for config in re.findall(r"[0-9a-f]{64}", json.dumps(folder))[:1]:
        technician.record("questions", "GET", f"{asked.R}/folder/{config}")
        for name in ("robot.yaml", "fmea.yaml", "nothing.yaml", "../x"):
            technician.record("questions", "GET", f"{asked.R}/folder/{config}/{name}")
    nobody = stand.people["nobody"]
    bodies: tuple[Any, ...] = (
        {"name": "viewer", "password": "wrong"}, {"name": "viewer"}, [], b"{"
    )  # fmt: skip
    for body in bodies:
        nobody.record("questions", "POST", "/api/v1/session", body)
    nobody.record("questions", "POST", "/api/v1/session", b"name=viewer",
                  {"Content-Type": "application/x-www-form-urlencoded"}, "form")  # fmt: skip
    nobody.record("questions", "POST", "/api/v1/session/code", {"code": "x"})
    nobody.record("questions", "GET", "/", None, {"Host": "evil.example"}, "host")
    nobody.record("questions", "OPTIONS", "/api/v1/robots")
    nobody.record("questions", "TRACE", "/")


@contextlib.contextmanager
def _listening(person: Person, wish: dict[str, Any]) -> Iterator[Callable[[], list[Any]]]:
    """Listen to the feed; the function waits for the next changes."""
    with person.socket("/api/v1/feed", page="Cookie" in person.headers) as feed:
        feed.send(json.dumps(wish))

        def changes() -> list[Any]:
            found: list[Any] = []
            while not found:
                said = json.loads(feed.recv(timeout=20))
                found = [one for one in said if one["kind"] not in ("ping", "ages")]
            return [{**one, "number": "<number>"} for one in found]

        yield changes


def _feed(stand: Stand) -> None:
    """Listen while somebody acts; write the frames."""
    book = stand.book
    for role, wish in (
        ("viewer", {}),
        ("cook", {}),
        ("token", {"robots": ["ropod_001"], "kinds": ["status"]}),
    ):
        with _listening(stand.people[role], wish) as changes:
            book.write("feed", f"snapshot_{role}", json.dumps(changes(), indent=1))
    operator = stand.people["operator"]
    with _listening(stand.people["viewer"], {"kinds": ["alarm", "fetch", "presence"]}) as changes:
        frames = changes()
        operator.record("feed", "POST", "/api/v1/alarms/1/note", {"text": "heard by the feed"})
        frames += changes()
        stand.people["technician"].record(
            "feed", "POST", f"{asked.R}/fetches",
            {"item": "", "from": "2026-01-05T07:00:00Z", "to": "2026-01-05T07:10:00Z"},
        )  # fmt: skip
        frames += changes()
        book.write("feed", "changes", json.dumps(frames, indent=1))
    for role in ("nobody", "robot", "viewer"):
        person = stand.people[role].copy()
        try:
            with person.socket("/api/v1/feed", page=role != "viewer") as feed:
                feed.send("nothing")
                said = str(feed.recv(timeout=20))
        except Exception as error:
            said = f"{type(error).__name__}: {error}"
        book.write("feed", f"refused_{role}", said)


def _changes(stand: Stand) -> None:
    """Let people change things, in a fixed order, and look at everything again."""
    found = stand.people["viewer"].ask("GET", "/api/v1/alarms?state=open&robot=ropod_001").json()
    is_open = str(found[0]["id"] if isinstance(found, list) else found["alarms"][0]["id"])
    for role, method, template, body in asked.changes():
        stand.clock.advance_s(1)
        path = template.replace("{open}", is_open)
        person = stand.people[role]
        if isinstance(body, dict) and body.get("revision") == "{revision}":
            alarm = re.sub(r"/\w+$", "", path)
            body = {**body, "revision": person.ask("GET", alarm).json()["alarm"]["revision"]}
        answer = person.record("changes", method, path, body)
        if path.endswith("/incidents") and answer.status < 300:
            released = f"{path}/{answer.json()['id']}/release"
            person.record("changes", "POST", released)
            person.record("changes", "POST", released)
        if path.endswith("/missions") and answer.status < 300:
            person.record("changes", "POST", f"{path}/{answer.json()['id']}/end", {})
        if path.endswith("/fetches") and answer.status < 300:
            person.record("changes", "DELETE", f"{path}/{answer.json()['id']}")
        if path.endswith("/tokens") and answer.status < 300:
            person.record("changes", "DELETE", f"{path}/{answer.json()['id']}")
    for path in asked.AFTER:
        for role in ("viewer", "admin"):
            stand.people[role].record("after", "GET", path)


def _downloads(stand: Stand) -> None:
    """Have files made, fetch and decode them."""
    person = stand.people["technician"]
    for wish in asked.DOWNLOADS:
        stand.clock.advance_s(1)  # lists are in order of time, and ids are drawn by chance
        made = person.record("downloads", "POST", "/api/v1/downloads", wish)
        if made.status >= 300:
            continue
        here = f"/api/v1/downloads/{made.json()['id']}"
        wait_for(partial(_has_ended, person, here), "a download")
        person.record("downloads", "GET", here)
        person.record("downloads", "GET", f"{here}/file")
        person.record("downloads", "GET", f"{here}/file", None, {"Range": "bytes=0-9"}, "range")
        stand.people["operator"].record("downloads", "GET", f"{here}/file")
        person.record("downloads", "DELETE", here)
    for path in ("/downloads", "/pieces/downloads", "/api/v1/downloads"):
        person.record("downloads", "GET", path, note="at last")


def _has_ended(person: Person, download: str) -> bool:
    """Tell whether a download is made, or never will be."""
    return person.ask("GET", download).json()["state"] in _ENDS


def _verbs(stand: Stand) -> None:
    """Run the command line's verbs against the server."""
    token = stand.people["token"].headers["Authorization"].partition(" ")[2]
    side = stand.side
    where = f"http://127.0.0.1:{_PORT}"
    tell(stand.book, "verb_no_token", side.run(["items", f"{where}/robots/ropod_001"]))
    tell(stand.book, "sign_in_wrong", side.run(["sign-in", where], stdin=b"abt_x_y\n"))
    tell(stand.book, "sign_in", side.run(["sign-in", where], stdin=token.encode() + b"\n"))
    actions = ("mission", "incident", "alarm", "fmea")
    tell(stand.book, "verb_status_all", side.run(["status", where]))
    tell(stand.book, "verb_items_all", side.run(["items", where]))
    for line in asked.VERBS:
        words = line.split()
        at = 2 if words[0] in actions and len(words) > 1 and not words[1].startswith("-") else 1
        place = ["--where"] if words[0] == "rules" else []
        command = [*words[:at], *place, f"{where}/robots/ropod_001", *words[at:]]
        tell(stand.book, f"verb_{line}", side.run(command))
    for made in ("tasks.csv", "plot.svg"):
        path = side.scratch / made
        text = path.read_text(errors="replace") if path.exists() else "none"
        stand.book.write("cli", f"made_{made}", text)
    tell(stand.book, "sign_out", side.run(["sign-out", where]))
    tell(stand.book, "verb_signed_out", side.run(["items", f"{where}/robots/ropod_001"]))


def _statics(stand: Stand) -> None:
    """List static files that pages name, with the hash of what they hold."""
    found = {re.sub(r"\?.*", "", one) for one in stand.links if one.startswith("/static/")}
    lines = []
    for path in sorted(found):
        answer = stand.people["nobody"].ask("GET", path)
        digest = hashlib.sha256(answer.body).hexdigest()
        name = stand.book.clean(path)
        lines.append(f"{name} {answer.status} {answer.header('content-type')} {digest}")
    stand.book.write("", "static", "\n".join(lines))


def _beside(stand: Stand, running: Running) -> None:
    """Run what stands beside serving, then end the server and look at what it leaves."""
    stand.serve("clock", "clock")
    stand.serve("signing_keys", "signing-key")
    stand.serve("signing_key_nothing", "signing-key", "ropod_001", "confirm")
    stand.serve("verify_audit", "verify-audit")
    stand.serve("verify_audit_wrong", "verify-audit", "--head", "1 " + "ab" * 32)
    stand.serve("second")
    stand.book.write("cli", "served", "\n".join(
        ["== stdout", running.stdout.read_text(), "== stderr", running.stderr.read_text(),
         f"exit {running.stop()}"]))  # fmt: skip
    for person in stand.people.values():
        person.close()
    copied = stand.side.scratch / "restored"
    shutil.rmtree(copied, ignore_errors=True)
    shutil.copytree(stand.data, copied)
    stand.data = copied
    stand.serve("verify_restored", "verify-audit")
    stand.clock.set_ns(NOW_NS + 90 * 86_400 * NS)
    again = stand.begin()
    stand.enter()
    for path in ("/api/v1/robots", "/api/v1/alarms", "/api/v1/clock", "/", f"{asked.R}/items"):
        stand.people["technician"].record("restored", "GET", path)
    stand.book.write("cli", "served_again", f"exit {again.stop()}")
    for words in (["--host", "0.0.0.0"], ["cert"], ["cert", "--host", "fleet.example"]):
        stand.serve("_".join(words), *words)


def _filled(path: str, robot: str) -> str:
    """Put names in the place of a path's parameters."""
    return re.sub(
        r"{(\w+)(?::\w+)?}",
        lambda found: robot if found[1] == "robot" else asked.FORMS.get(found[1], "nothing"),
        path,
    )


def _port_is_free() -> bool:
    """Tell whether nobody listens at the port that both sides take."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", _PORT)) != 0
