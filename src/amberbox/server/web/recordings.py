"""Pages of recordings and downloads: the recordings on the server, and files made of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args
from urllib.parse import urlencode

from fastapi import HTTPException, Query, Request, Response
from fastapi import Path as fastapi_Path
from fastapi.responses import FileResponse
from sqlalchemy import Connection, Select, case, func, select

from amberbox.blackbox.journal import channels
from amberbox.core.api import Card, Download, DownloadFormat, Mission
from amberbox.core.clock import NS
from amberbox.core.timestamps import format_time, maybe_time
from amberbox.server.accounts.robots import KnownRobot
from amberbox.server.archive.catalogue import PUT
from amberbox.server.data import downloads
from amberbox.server.data.downloads import OPEN, SETTING, DownloadJob, DownloadRequest, Downloads
from amberbox.server.data.recordings import JournalListing
from amberbox.server.drawing.charts import KINDS, CoverageInterval, coverage, coverage_swatch
from amberbox.server.http.auth import Fleet, OfRobot, Who
from amberbox.server.http.forms import download_headers
from amberbox.server.schema import FETCH, INCIDENT, JOURNALS, MISSION, MISSION_NOTE, ROW, UPLOAD
from amberbox.server.services.context import Caller, Services
from amberbox.server.services.recordings import list_downloads, list_fetches
from amberbox.server.services.robots import list_cards, read_card
from amberbox.server.settings import read
from amberbox.server.web import text
from amberbox.server.web.coverage import (
    WINDOWS,
    CoverageBar,
    RetentionOfRobot,
    RobotRecordings,
    Window,
    cover,
    fitting,
    journals,
    parts,
    read_recordings,
    with_journals,
    with_journals_of,
)
from amberbox.server.web.page import PageRoutes, render
from amberbox.server.web.text import catalogue, drawing_words


@dataclass(frozen=True, slots=True)
class CopyProgress:
    """Journals of a robot that are being copied, their size in bytes, and the bytes copied."""

    files: int = 0
    bytes: int = 0
    copied: int = 0


@dataclass(frozen=True, slots=True)
class HeldRecordings:
    """The recordings of a robot on the server; ``stamp`` changes whenever something else does."""

    files: int = 0
    bytes: int = 0
    rows: int = 0
    waiting: int = 0
    copying: CopyProgress = CopyProgress()
    stamp: str = ""


def held(
    connection: Connection, folder: Path, robots: Sequence[str]
) -> Mapping[str, HeldRecordings]:
    """Return the recordings of robots on the server, and the progress of copying."""
    sums = {row.robot: row for row in connection.execute(_sums(robots))}
    coming = _coming(connection, folder, robots)
    stamps = _stamps(connection, robots)
    return {
        robot: replace(
            _figures(sums[robot]) if robot in sums else HeldRecordings(),
            copying=coming.get(robot, CopyProgress()), stamp="-".join(stamps[robot]),
        )
        for robot in robots
    }  # fmt: skip


def _figures(row: Any) -> HeldRecordings:
    return HeldRecordings(int(row.files), int(row.size), int(row.lines), int(row.waiting))


def _sums(robots: Sequence[str]) -> Select[Any]:
    here, table = JOURNALS.c.raw_gone.is_(False), JOURNALS.c
    return (
        select(
            table.robot,
            func.sum(case((here, 1), else_=0)).label("files"),
            func.sum(case((here, table.bytes), else_=0)).label("size"),
            func.sum(case((table.columns_gone.is_(False), table.rows), else_=0)).label("lines"),
            func.sum(case((table.state == PUT, 1), else_=0)).label("waiting"),
        )
        .where(table.robot.in_(robots))
        .group_by(table.robot)
    )


def _coming(connection: Connection, folder: Path, robots: Sequence[str]) -> dict[str, CopyProgress]:
    found: dict[str, CopyProgress] = {}
    wanted = select(UPLOAD).where(UPLOAD.c.robot.in_(robots), UPLOAD.c.state == "incoming")
    for row in connection.execute(wanted):
        known = found.get(row.robot, CopyProgress())
        copied = known.copied + _come(folder / row.path) if row.path else known.copied
        found[row.robot] = CopyProgress(known.files + 1, known.bytes + row.bytes, copied)
    return found


def _come(path: Path) -> int:
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _stamps(connection: Connection, robots: Sequence[str]) -> dict[str, list[str]]:
    """Return texts that change whenever something on the pages of recordings does."""
    found: dict[str, list[str]] = {robot: [] for robot in robots}
    for chosen in _questions():
        table = chosen.selected_columns[0]
        sums = {
            row[0]: ".".join(str(value or 0) for value in row[1:])
            for row in connection.execute(chosen.where(table.in_(robots)).group_by(table))
        }
        for robot in robots:
            found[robot].append(sums.get(robot, ""))
    return found


def _questions() -> Iterator[Select[Any]]:
    j, count = JOURNALS.c, func.count()
    flags = func.sum(case((j.raw_gone, 1), else_=0) + case((j.columns_gone, 1), else_=0))
    yield select(j.robot, count, func.max(j.put_ns), flags, func.max(j.batch), _states(j.state))
    yield select(UPLOAD.c.robot, count, func.max(UPLOAD.c.ended_ns), _sum(UPLOAD.c.signed))
    yield select(MISSION.c.robot, count, func.max(MISSION.c.to_ns))
    yield select(MISSION_NOTE.c.robot, count)
    yield select(INCIDENT.c.robot, count, func.max(INCIDENT.c.released_ns))
    yield select(FETCH.c.robot, count, func.max(FETCH.c.ended_ns), _states(FETCH.c.state),
                 func.sum(func.length(FETCH.c.files)))  # fmt: skip
    is_derived = ROW.c.channel.in_((channels.MISSION, channels.INCIDENT))
    yield select(ROW.c.robot, count, func.max(ROW.c.log_ns)).where(is_derived)


def _states(column: Any) -> Any:
    """Return a number that changes when rows change their state."""
    return func.sum(func.length(column))


def _sum(flag: Any) -> Any:
    return func.sum(case((flag, 1), else_=0))


routes = PageRoutes()

Show = Literal["all", "trouble", "coming", "deleted"]
SHOWS: Sequence[Show] = ("all", "trouble", "coming", "deleted")
_MOST = 10_000
_PAGE = 50
_LISTED = 100
"""Maximum number of intervals in the list beside a bar."""
_COMING = ("copying", "waiting", "aside")

After = Annotated[str, Query(max_length=400)]
Names = Annotated[list[Annotated[str, Query(max_length=64)]], Query(max_length=200)]
Chosen = Annotated[Window | None, Query(description="empty: what holds all, at most 7 days")]
NOTHING: list[str] = []


@dataclass(frozen=True, slots=True)
class RecordingsRow:
    """A robot in the overview of recordings."""

    card: Card
    held: HeldRecordings


@dataclass(frozen=True, slots=True)
class RecordingsQuery:
    """Query of a robot's recordings, as in the address."""

    window: Window = "7d"
    show: Show = "all"
    after: str = ""
    mission: str = ""


@routes.get("/recordings", "items.read", each=True)
def show(request: Request, fleet: Fleet, who: Who, window: Chosen = None) -> Response:
    """Show the recordings of all robots: sums at once, the rest is loaded later."""
    lines = _lines(fleet, who)
    window = window or fitting(fleet, [line.card.robot for line in lines])
    return render(
        request, "recordings/recordings.html", lines=lines, window=window, windows=tuple(WINDOWS),
        swatches=_swatches(), total=_total(lines), may_download=who.may_some("data.download"),
        **_words(),
    )  # fmt: skip


@routes.get("/pieces/recordings", "items.read", each=True)
def show_states(request: Request, fleet: Fleet, who: Who, robot: Names = NOTHING) -> Response:
    """Return the fragment with the progress of copying, requested every 10 s."""
    return render(request, "recordings/states.html", lines=_lines(fleet, who, robot), **_words())


@routes.get("/pieces/recordings/{robot}", "items.read")
def show_card(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, window: Window = "7d",
    link: bool = True,
) -> Response:  # fmt: skip
    """Return the fragment of one robot: its bar and the integrity of its journals.

    With ``link`` also the number of missions and incidents, and a link to its page.
    """
    found = with_journals(fleet, robot, read_recordings(fleet, who, robot, missions=link), window)
    seen = cover(fleet, who, robot, found, window)
    return render(
        request, "recordings/card.html", found=found, link=link,
        **_drawn(seen, robot.id, window), **_words(),
    )  # fmt: skip


@routes.get("/recordings/{robot}", "items.read")
def show_robot(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, window: Chosen = None,
    show: Show = "all", after: After = "", mission: After = "",
) -> Response:  # fmt: skip
    """Show the recordings of a robot; what needs workers is loaded later."""
    look = RecordingsQuery(window or fitting(fleet, [robot.id]), show, after, mission)
    return render(
        request, "recordings/robot.html", card=read_card(fleet, robot),
        robot=robot.id, held=_held(fleet, [robot.id])[robot.id], look=look, windows=tuple(WINDOWS),
        swatches=_swatches(), **_may(who, robot), **_fetches(fleet, robot),
        **_journals(fleet, robot, journals(fleet, robot), look), **_words(),
    )  # fmt: skip


@routes.get("/pieces/recordings/{robot}/missions", "items.read")
def show_missions(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, mission: After = ""
) -> Response:
    """Return the fragment with the missions of a robot."""
    found = read_recordings(fleet, who, robot, incidents=False)
    ids = [one.id for one in found.missions]
    start = ids.index(mission) + 1 if mission in ids else 0
    page = found.missions[start : start + _PAGE]
    found = with_journals_of(fleet, robot, found, page)
    return render(
        request, "recordings/missions.html", found=found, look=RecordingsQuery(mission=mission),
        **_missions(found, page), **_may(who, robot), **_words(),
    )  # fmt: skip


@routes.get("/pieces/recordings/{robot}/incidents", "items.read")
def show_incidents(request: Request, fleet: Fleet, who: Who, robot: OfRobot) -> Response:
    """Return the fragment with the incidents of a robot."""
    found = read_recordings(fleet, who, robot, missions=False)
    return render(request, "recordings/incidents.html", found=found, **_may(who, robot), **_words())


@routes.get("/pieces/recordings/{robot}/fetches", "data.query")
def show_fetches(request: Request, fleet: Fleet, who: Who, robot: OfRobot) -> Response:
    """Return the fragment with the requests for windows to a robot."""
    return render(
        request, "recordings/fetches.html", robot=robot.id, **_fetches(fleet, robot),
        **_may(who, robot), **_words(),
    )  # fmt: skip


@routes.get("/pieces/recordings/{robot}/journals", "items.read")
def show_journals(
    request: Request, fleet: Fleet, who: Who, robot: OfRobot, show: Show = "all", after: After = ""
) -> Response:
    """Return the fragment with the journals of a robot."""
    look = RecordingsQuery(show=show, after=after)
    return render(
        request, "recordings/journals.html", robot=robot.id, look=look,
        **_journals(fleet, robot, journals(fleet, robot), look), **_may(who, robot), **_words(),
    )  # fmt: skip


def _lines(fleet: Services, who: Caller, only: Sequence[str] = ()) -> list[RecordingsRow]:
    with fleet.database.reading() as connection:
        seen = who.robots(connection, "items.read")
    mine = {robot.id for robot in seen if not only or robot.id in only}
    cards = [card for card in list_cards(fleet, who, "", "", _MOST) if card.robot in mine]
    known = _held(fleet, [card.robot for card in cards])
    cards.sort(key=lambda card: card.damaged_files == 0)
    return [RecordingsRow(card, known[card.robot]) for card in cards]


def _held(fleet: Services, robots: Sequence[str]) -> Mapping[str, HeldRecordings]:
    with fleet.database.reading() as connection:
        return held(connection, fleet.folder, robots)


def _total(lines: Sequence[RecordingsRow]) -> HeldRecordings:
    found = [line.held for line in lines]
    return HeldRecordings(sum(one.files for one in found), sum(one.bytes for one in found))


def _drawn(seen: CoverageBar, robot: str, window: Window) -> Mapping[str, Any]:
    label = catalogue().text("recordings.cover.label", robot=robot)
    drawn = [_described(one) for one in seen.stretches]
    bar = coverage(drawn, seen.axis, label=label, name=f"cover-{robot}", words=drawing_words())
    recorded = any(one.kind == "recorded" for one in seen.stretches)
    return {"cover": seen, "bar": bar, "recorded": recorded, "window": window,
            "parts": parts(seen.stretches, _LISTED)}  # fmt: skip


def _described(one: CoverageInterval) -> CoverageInterval:
    """Return an interval whose text also has its times, for the tooltip."""
    when = catalogue().text("recordings.cover.when", start=_utc(one.start), to=_utc(one.to))
    return CoverageInterval(one.start, one.to, one.kind, f"{one.text} {when}".strip())


def _utc(time_ns: int) -> str:
    return format_time(time_ns)[:16].replace("T", " ")


def _swatches() -> Sequence[tuple[str, Any]]:
    return [
        (kind, coverage_swatch(kind, name=f"key-{kind}", words=drawing_words())) for kind in KINDS
    ]


def _missions(found: RobotRecordings, page: Sequence[Mission]) -> Mapping[str, Any]:
    last = page[-1].id if page else ""
    more = last if page and found.missions[-1].id != last else ""
    return {
        "missions": [(one, found.share(one)) for one in page], "missions_more": more,
        "missions_all": len(found.missions),
    }  # fmt: skip


def _fetches(fleet: Services, robot: KnownRobot) -> Mapping[str, Any]:
    return {"fetches": list_fetches(fleet, robot, limit=_PAGE)}


def _journals(
    fleet: Services, robot: KnownRobot, found: Sequence[JournalListing], look: RecordingsQuery
) -> Mapping[str, Any]:
    chosen = [one for one in found if _fits(one, look.show)]
    chosen.sort(key=lambda one: not _fits(one, "trouble"))
    names = [_name(one) for one in chosen]
    start = names.index(look.after) + 1 if look.after in names else 0
    page = chosen[start : start + _PAGE]
    retaining = RetentionOfRobot(fleet, robot.id)
    return {
        "journals": [(_name(one), one, retaining.until(one)) for one in page],
        "journals_first": start, "journals_all": len(chosen), "files_all": len(found),
        "journals_more": names[start + _PAGE - 1] if len(names) > start + _PAGE else "",
        "counts": {name: sum(_fits(one, name) for one in found) for name in SHOWS},
        "shows": SHOWS, "days_kept": retaining.days,
    }  # fmt: skip


def _name(one: JournalListing) -> str:
    return f"{one.store_id}/{one.journal}"


def _fits(one: JournalListing, show: Show) -> bool:
    return {
        "all": True,
        "trouble": one.integrity in ("altered", "missing")
        or one.state in ("refused", "quarantined"),
        "coming": one.state in _COMING,
        "deleted": one.integrity == "deleted",
    }[show]


def _may(who: Caller, robot: KnownRobot) -> Mapping[str, bool]:
    return {
        "may_mark": who.may("incidents.write", robot),
        "may_begin": who.may("missions.write", robot),
        "may_download": who.may("data.download", robot),
        "may_fetch": who.may("data.fetch", robot),
    }


def _words() -> Mapping[str, Any]:
    return {"size": text.size, "count": text.count, "percent": text.percent,
            "rfc3339": format_time}  # fmt: skip


_DIGEST = Annotated[str, fastapi_Path(max_length=64)]
_TYPE = "application/octet-stream"


@routes.get("/recordings/{robot}/damaged/{sha256}", "data.download")
def fetch_damaged(fleet: Fleet, who: Who, robot: OfRobot, sha256: _DIGEST) -> FileResponse:
    """Return a file that was set aside as damaged, by the SHA-256 that the robot sent."""
    u = UPLOAD.c
    chosen = select(UPLOAD).where(u.robot == robot.id, u.sha256 == sha256, u.state == "quarantined")
    with fleet.database.begin() as connection:
        row = connection.execute(chosen).first()
        path = fleet.folder / row.path if row and row.path else None
        if row is None or path is None or not path.is_file():
            raise HTTPException(404, "there is no such damaged file: it may have been deleted")
        details = {"robot": robot.id, "bytes": row.bytes}
        now_ns = fleet.clock.wall_ns()
        who.note(connection, now_ns, "downloads.fetch", row.journal, details=details)
    name = f"damaged-{sha256[:16]}.mcap"
    return FileResponse(path, media_type=_TYPE, headers=download_headers(name))


download_routes = PageRoutes()

FORMATS: Sequence[DownloadFormat] = get_args(DownloadFormat)
_NONE: list[str] = []
_HOUR_NS = 3600 * NS

TextList = Annotated[list[Annotated[str, Query(max_length=300)]], Query(max_length=200)]
Text = Annotated[str, Query(max_length=64)]


@dataclass(frozen=True, slots=True)
class DownloadFormValues:
    """The initial values of the form, from the address."""

    robots: Sequence[str] = field(default=())
    missions: Sequence[str] = field(default=())
    items: Sequence[str] = field(default=())
    from_: str = ""
    to: str = ""
    format: str = "csv"


@dataclass(frozen=True, slots=True)
class DownloadRow:
    """A download in the list; times are RFC 3339, ``again`` is the address of its form."""

    about: Download
    start: str | None
    to: str | None
    until: str | None
    again: str

    @property
    def is_open(self) -> bool:
        """Return whether it is not finished yet."""
        return self.about.state in OPEN


@download_routes.get("/downloads", "data.download", each=True)
def show_downloads(
    request: Request, fleet: Fleet, who: Who, robot: TextList = _NONE,
    mission: TextList = _NONE, item: TextList = _NONE,
    from_: Annotated[Text, Query(alias="from")] = "", to: Text = "", format: Text = "csv",
    after: Text = "", all: bool = False,
) -> Response:  # fmt: skip
    """Show one's downloads, and the form for a new one."""
    options = _options(fleet)
    begun = DownloadFormValues(
        robot, mission, item, from_, to, format if format in FORMATS else "csv"
    )
    return render(
        request, "recordings/downloads.html", begun=begun, formats=FORMATS,
        robots=_robots(fleet, who), is_begun=bool(robot or mission or item or from_),
        options=options, **_listed(fleet, who, options, after, all=all),
    )  # fmt: skip


@download_routes.get("/pieces/downloads", "data.download", each=True)
def show_download_list(
    request: Request, fleet: Fleet, who: Who, after: Text = "", all: bool = False
) -> Response:
    """Return the fragment with the list of downloads."""
    shown = _listed(fleet, who, _options(fleet), after, all=all)
    return render(request, "recordings/downloads_list.html", **shown)


def _robots(fleet: Services, who: Caller) -> list[str]:
    with fleet.database.reading() as connection:
        return [robot.id for robot in who.robots(connection, "data.download")]


def _options(fleet: Services) -> Downloads:
    with fleet.database.reading() as connection:
        return read(connection, SETTING, Downloads)


def _listed(
    fleet: Services, who: Caller, options: Downloads, after: str, *, all: bool
) -> Mapping[str, Any]:
    found = list_downloads(fleet, who, limit=_PAGE + 1, after=after, all=all)
    with fleet.database.reading() as connection:
        jobs = downloads.find_all(connection, [one.id for one in found[:_PAGE]])
    lines = [_line(one, jobs[one.id], options) for one in found[:_PAGE] if one.id in jobs]
    return {
        "lines": lines, "more": found[_PAGE - 1].id if len(found) > _PAGE else "",
        "after": after, "all": all, "called": _called,
        "is_admin": who.may("users.read"), "size": text.size, "percent": text.percent,
    }  # fmt: skip


def _called(missions: Sequence[str]) -> list[str]:
    """Return the names of missions on the page; quick choices in words."""
    words = catalogue().texts
    return [words.get(f"downloads.quick.{name.replace(':', '_')}", name) for name in missions]


def _line(one: Download, job: DownloadJob, options: Downloads) -> DownloadRow:
    ended_ns = job.ended_ns if job.state == "done" else None
    until = None if ended_ns is None else format_time(ended_ns + int(options.kept_h * _HOUR_NS))
    wanted = job.wanted
    return DownloadRow(
        one, maybe_time(wanted.from_ns), maybe_time(wanted.to_ns), until, _again(wanted)
    )


def _again(wanted: DownloadRequest) -> str:
    """Return the address of the form, filled in with an earlier request."""
    query = [("robot", name) for name in wanted.robots]
    query += [("mission", name) for name in wanted.missions]
    query += [("item", name) for name in dict.fromkeys([*wanted.items, *wanted.variables])]
    span = ("from", maybe_time(wanted.from_ns)), ("to", maybe_time(wanted.to_ns))
    query += [(name, time) for name, time in span if time]
    return f"/downloads?{urlencode([*query, ('format', wanted.format)])}#new"
