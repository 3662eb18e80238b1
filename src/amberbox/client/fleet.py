"""A server of a fleet, asked in Python: ``Fleet("https://fleet.example:8443").robots()``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar
from urllib.parse import quote

import msgspec

from amberbox.client import data_models, downloading, models, tables
from amberbox.client.address import read_address
from amberbox.client.fleet_alarms import AlarmCalls
from amberbox.client.paging import PAGE, paged
from amberbox.client.times import Time, said
from amberbox.client.wire import TIMEOUT_S, Wire

if TYPE_CHECKING:
    from amberbox.blackbox.query.table import Table
    from amberbox.client.downloading import Progress
    from amberbox.client.feed import Change

By = Literal["received", "timestamp"]
ROWS = 200_000
"""Rows of one answer; more come in several."""
_Answer = TypeVar("_Answer")


class Fleet(AlarmCalls):
    """One server. A context manager; threads may share it.

    ``token`` is an API token; without one it is ``AMBERBOX_TOKEN`` of the environment, else that
    of ``amberbox sign-in``. ``ca`` is the fingerprint of the server's authority
    (``sha256:...``) or a PEM file; without, what sign-in pinned, else what the system trusts.

    All methods raise UnreachableError, NotSignedInError, NotAllowedError, UsageError for what is
    not there, and AmberboxError for what the server could not do; each names the address.
    """

    def __init__(
        self, url: str, token: str | None = None, ca: str | Path | None = None,
        timeout_s: float = TIMEOUT_S,
    ) -> None:  # fmt: skip
        from amberbox.client.opening import wire_to

        self.url = read_address(url).url
        self.wire: Wire = wire_to(url, token, ca, timeout_s)

    def __enter__(self) -> Fleet:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let the connection go."""
        self.wire.close()

    # Robots and how they are.

    def robots(self, group: str = "") -> list[models.Card]:
        """Return the robots that one may see, by id."""
        return [*paged(self.wire, "/robots", models.Card, lambda r: r.robot, {"group": group})]

    def robot(self, robot: str) -> models.Card:
        """Return one robot at a glance."""
        return self._get(_of(robot), models.Card)

    def status(self, robot: str) -> models.StatusTree:
        """Return the components of a robot as a tree."""
        return self._get(f"{_of(robot)}/status", models.StatusTree)

    def timeline(
        self, robot: str, from_: Time = "now-1h", to: Time = "now", component: str = "",
        points: int = 500,
    ) -> models.Timeline:  # fmt: skip
        """Return which component was in what state when."""
        asked = {**_span(from_, to), "component": component, "points": points}
        return self._get(f"{_of(robot)}/timeline", models.Timeline, asked)

    def events(
        self, robot: str, from_: Time = None, to: Time = None, kind: str = "", limit: int = 100,
        newest: bool = True,
    ) -> list[models.Event]:  # fmt: skip
        """Return events in order of time: the newest of a range, or the first ones."""
        asked = {**_span(from_, to), "kind": kind, "limit": limit, "newest": newest}
        return self._get(f"{_of(robot)}/events", list[models.Event], asked)

    # What was recorded.

    def items(self, robot: str) -> list[data_models.Item]:
        """Return the data items that the server has rows of."""
        return self._get(f"{_of(robot)}/items", list[data_models.Item])

    def item(self, robot: str, item: str) -> data_models.ItemDetail:
        """Return an item with its columns."""
        return self._get(f"{_of(robot)}/items/{quote(item, safe='')}", data_models.ItemDetail)

    def query(
        self, robot: str, item: str, variables: Sequence[str] | None = None, from_: Time = None,
        to: Time = None, by: By = "received", points: int | None = None,
    ) -> Table:  # fmt: skip
        """Return rows of ``[from_, to)`` (see ``Record.query``); ``points`` thins them out.

        Of more than a million rows, ``points`` gives ``x:min``, ``x:max``, ``x:mean``, ``x:count``.
        """
        pages = self.pages(robot, item, variables, from_, to, by, points)
        return tables.joined([page.table for page in pages])

    def pages(
        self, robot: str, item: str, variables: Sequence[str] | None = None, from_: Time = None,
        to: Time = None, by: By = "received", points: int | None = None, rows: int = ROWS,
    ) -> Iterator[tables.Page]:  # fmt: skip
        """Yield the rows of a query, some at a time."""
        start: str = said(from_)
        while True:
            asked = {
                "item": item, "variables": variables, **_span(start, to), "by": by,
                "points": points, "limit": None if points else rows, "format": tables.form(),
            }  # fmt: skip
            page = tables.page_of(self.wire.get(f"{_of(robot)}/query", asked))
            yield page
            if not page.next:
                return
            start = page.next

    def statistics(
        self, robot: str, item: str, variables: Sequence[str] | None = None, from_: Time = None,
        to: Time = None,
    ) -> data_models.Summaries:  # fmt: skip
        """Return number of values, least, greatest and mean of a range."""
        asked = {"item": item, "variables": variables, **_span(from_, to)}
        return self._get(f"{_of(robot)}/statistics", data_models.Summaries, asked)

    def gaps(
        self, robot: str, item: str = "", from_: Time = None, to: Time = None
    ) -> list[data_models.Gap]:
        """Return what is missing in a range, and why, in order of time."""
        found: dict[data_models.Gap, None] = {}
        start = said(from_)
        while True:
            asked = {"item": item, **_span(start, to), "limit": PAGE}
            answer = self._get(f"{_of(robot)}/gaps", data_models.Gaps, asked)
            fresh = [gap for gap in answer.gaps if gap not in found]
            found.update(dict.fromkeys(fresh))
            if not (answer.more and fresh):
                return list(found)
            start = answer.gaps[-1].from_

    def missions(
        self, robot: str, name: str = "", failed: bool = False, from_: Time = None, to: Time = None
    ) -> list[data_models.Mission]:
        """Return missions, newest first."""
        asked = {"name": name, "failed": failed, **_span(from_, to)}
        path = f"{_of(robot)}/missions"
        return [*paged(self.wire, path, data_models.Mission, lambda m: m.id, asked)]

    def begin_mission(
        self, robot: str, name: str, parameters: Mapping[str, Any] | None = None, at: Time = None
    ) -> data_models.Mission:
        """Begin a mission on the server."""
        body = {"name": name, "parameters": dict(parameters or {}), "at": said(at)}
        return self._send("POST", f"{_of(robot)}/missions", data_models.Mission, body)

    def end_mission(
        self, robot: str, mission: str, outcome: str = "done", at: Time = None
    ) -> data_models.Mission:
        """End a mission that was begun on the server."""
        path = f"{_of(robot)}/missions/{quote(mission, safe='')}/end"
        return self._send("POST", path, data_models.Mission, {"outcome": outcome, "at": said(at)})

    def notes(
        self, robot: str, from_: Time = None, to: Time = None
    ) -> list[data_models.MomentNote]:
        """Return what people remarked on moments, on missions too, newest first."""
        path = f"{_of(robot)}/notes"
        return [*paged(self.wire, path, data_models.MomentNote, lambda n: n.id, _span(from_, to))]

    def annotate(self, robot: str, text: str, at: Time = None) -> data_models.MomentNote:
        """Remark something on a moment of a robot, whether a mission was under way or not."""
        body = {"text": text, "at": said(at)}
        return self._send("POST", f"{_of(robot)}/notes", data_models.MomentNote, body)

    def incidents(
        self, robot: str, from_: Time = None, to: Time = None
    ) -> list[data_models.Incident]:
        """Return the windows that robots or people want kept, newest first."""
        path = f"{_of(robot)}/incidents"
        return [*paged(self.wire, path, data_models.Incident, lambda i: i.id, _span(from_, to))]

    def mark_incident(self, robot: str, from_: Time, to: Time, reason: str) -> data_models.Incident:
        """Mark a window: what the server has of it, or gets, is kept until it is released."""
        body = {**_span(from_, to), "reason": reason}
        return self._send("POST", f"{_of(robot)}/incidents", data_models.Incident, body)

    def release_incident(self, robot: str, incident: str) -> data_models.Incident:
        """Let a window go that was marked on the server."""
        path = f"{_of(robot)}/incidents/{quote(incident, safe='')}/release"
        return self._send("POST", path, data_models.Incident)

    def recordings(self, robot: str) -> list[data_models.Recording]:
        """Return the journals of a robot by name, with what is known of their integrity."""
        path = f"{_of(robot)}/recordings"
        return [
            *paged(self.wire, path, data_models.Recording, lambda r: f"{r.store_id}/{r.journal}")
        ]

    # What is still on the robot.

    def fetch(self, robot: str, item: str, from_: Time, to: Time) -> data_models.Fetch:
        """Ask a robot for a window of an item, of all items without a name."""
        body = {"item": item, **_span(from_, to)}
        return self._send("POST", f"{_of(robot)}/fetches", data_models.Fetch, body)

    def fetches(self, robot: str) -> list[data_models.Fetch]:
        """Return what was asked of a robot, newest first."""
        path = f"{_of(robot)}/fetches"
        return [*paged(self.wire, path, data_models.Fetch, lambda f: f.id)]

    def fetched(self, robot: str, fetch: str) -> data_models.Fetch:
        """Return how far a window is that was asked of a robot."""
        return self._get(f"{_of(robot)}/fetches/{fetch}", data_models.Fetch)

    # Files.

    def start_download(
        self, robots: Sequence[str], items: Sequence[str] = (), *, format: str = "csv",
        from_: Time = None, to: Time = None, missions: Sequence[str] = (),
        variables: Mapping[str, Sequence[str]] | None = None,
    ) -> data_models.Download:  # fmt: skip
        """Let the server make a file: ``csv``, ``parquet``, ``mcap`` or ``journals``."""
        body = {
            "robots": list(robots), "items": list(items), "missions": list(missions),
            "variables": {k: list(v) for k, v in (variables or {}).items()}, "format": format,
            **_span(from_, to),
        }  # fmt: skip
        return self._send("POST", "/downloads", data_models.Download, body)

    def downloads(self) -> list[data_models.Download]:
        """Return one's own downloads, newest first."""
        return [*paged(self.wire, "/downloads", data_models.Download, lambda d: d.id)]

    def download(self, download: str) -> data_models.Download:
        """Return how far a download is."""
        return self._get(f"/downloads/{download}", data_models.Download)

    def cancel_download(self, download: str) -> data_models.Download:
        """Stop a download, or throw it away when it is done."""
        return self._send("DELETE", f"/downloads/{download}", data_models.Download)

    def wait_download(
        self, download: str, progress: Progress | None = None, limit_s: float | None = None
    ) -> data_models.Download:
        """Wait until a download is made; raises AmberboxError when it will not be."""
        return downloading.waited(self, download, progress, limit_s)

    def save_download(
        self, download: str, target: Path | str, progress: Progress | None = None
    ) -> Path:
        """Save the file of a download; what was cut short before goes on where it ended."""
        return downloading.saved(self, download, Path(target), progress)

    # What is wrong, and what can be.

    def diagnoses(
        self, robot: str, from_: Time = None, to: Time = None
    ) -> list[models.DiagnosisLine]:
        """Return what the robot's watcher found, newest first."""
        path = f"{_of(robot)}/diagnoses"
        return [*paged(self.wire, path, models.DiagnosisLine, lambda d: d.id, _span(from_, to))]

    def diagnosis(self, robot: str, diagnosis: str) -> dict[str, Any]:
        """Return a diagnosis with all revisions and what people added."""
        return self._get(f"{_of(robot)}/diagnoses/{quote(diagnosis, safe='')}", dict[str, Any])

    def diagnose(
        self, robot: str, at: Time = None, symptoms: Mapping[str, str] | None = None,
        answers: Mapping[str, str] | None = None, *, diagnosis: str = "",
        engine: str = "covering", exposure_h: float | None = None,
    ) -> dict[str, Any]:  # fmt: skip
        """Ask what is broken, now or then, what if: the object of ``amberbox diagnose --json``."""
        body = {
            "at": said(at), "symptoms": dict(symptoms or {}), "answers": dict(answers or {}),
            "diagnosis": diagnosis, "engine": engine, "exposure_h": exposure_h,
        }  # fmt: skip
        return self._send("POST", f"{_of(robot)}/diagnose", dict[str, Any], body)

    def answer(self, robot: str, diagnosis: str, test: str, answer: str) -> dict[str, Any]:
        """Say what a test gave; returns the diagnosis ranked anew."""
        path = f"{_of(robot)}/diagnoses/{quote(diagnosis, safe='')}/answers"
        return self._send("POST", path, dict[str, Any], {"test": test, "answer": answer})

    def fmea(self, robot: str, at: Time = None, exposure_h: float | None = None) -> dict[str, Any]:
        """Return the failure modes: ``table``, ``criticality`` and ``coverage``."""
        asked = {"at": said(at), "exposure_h": exposure_h}
        return self._get(f"{_of(robot)}/fmea", dict[str, Any], asked)

    def faulttrees(
        self, robot: str, effect: str = "", *, cut_sets: int = 100, order: int | None = None,
        at: Time = None, exposure_h: float | None = None,
    ) -> dict[str, Any]:  # fmt: skip
        """Return the fault trees of all functions; of one with cut sets and what matters."""
        asked = {"effect": effect, "cut_sets": cut_sets, "order": order, "at": said(at),
                 "exposure_h": exposure_h}  # fmt: skip
        return self._get(f"{_of(robot)}/faulttrees", dict[str, Any], asked)

    def rules(
        self, robot: str, query: str, want: str = "why", from_: Time = None, to: Time = None,
        steps: int = 0,
    ) -> dict[str, Any]:  # fmt: skip
        """Return all answers of a goal to the robot's rules: ``answers``, ``proof``, ``failed``."""
        body = {"query": query, "want": want, **_span(from_, to), "steps": steps}
        return self._send("POST", f"{_of(robot)}/rules", dict[str, Any], body)

    # The server itself, and what changes.

    def follow(
        self, robots: Sequence[str] | None = None, kinds: Sequence[str] | None = None,
        live: Mapping[str, Sequence[str]] | None = None,
    ) -> Iterator[Change]:  # fmt: skip
        """Yield changes as they come, a snapshot first (``feed.follow``); needs websockets."""
        from amberbox.client.feed import follow

        return follow(self.wire, robots, kinds, live)

    def audit(self, from_: Time = None, to: Time = None, limit: int = 100) -> list[models.AuditRow]:
        """Return rows of the audit log, newest first."""
        return self._get("/audit", list[models.AuditRow], {**_span(from_, to), "limit": limit})

    def metrics(self) -> str:
        """Return the server's own figures, in Prometheus' text format."""
        return self.wire.get("/metrics").body.decode()

    def _get(
        self, path: str, kind: type[_Answer], query: Mapping[str, Any] | None = None
    ) -> _Answer:
        return msgspec.json.decode(self.wire.get(path, query).body, type=kind)

    def _send(self, method: str, path: str, kind: type[_Answer], body: Any = None) -> _Answer:
        return msgspec.json.decode(self.wire.send(method, path, body).body, type=kind)


def _of(robot: str) -> str:
    return f"/robots/{quote(robot, safe='')}"


def _span(from_: Time, to: Time) -> dict[str, str]:
    return {"from": said(from_), "to": said(to)}
