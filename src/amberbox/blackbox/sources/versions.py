"""Versions at the start of a run: system, packages, git commits, container images; and changes."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import select
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import PathDistribution
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias

import msgspec

from amberbox.core.container_engine import ask_engine, engine_sockets
from amberbox.core.errors import AmberboxError
from amberbox.core.options import option
from amberbox.core.source import Sink, TopicOptions
from amberbox.core.topic_selection import unknown_topics
from amberbox.core.types import Topic
from amberbox.core.version import __version__

SAMPLE = """\
- versions:
    python: {navigation: /opt/navigation}
    debian: [ros-noetic-*, linux-image-*]
    git: {drivers: /opt/robot/drivers}
    ros: [/opt/ros/noetic, /opt/robot/workspace/install]
    every_s: 1 h
"""
PASSIVE = (
    "reads files, and asks dpkg-query, git (without hooks or locks) and the container engine's "
    "socket"
)

PEER = "this computer"
KINDS = ("system", "amberbox", "python", "debian", "git", "containers", "ros")
MOST = 2000  # entries of a kind
_MOST_EVENTS = 20  # of a kind at once
_LONGEST = 200  # characters of a name or version
_WAIT_S = 8.0
_OUTPUT_BYTES = 4 << 20
_FILE_BYTES = 64 << 10
_REFS_BYTES = 4 << 20
_COMMIT = re.compile(r"[0-9a-f]{40}|[0-9a-f]{64}")
_TAG = r"<{0}(?:\s[^<>]*)?>\s*([^<>]*?)\s*</{0}\s*>"
_NAME, _VERSION = (re.compile(_TAG.format(tag)) for tag in ("name", "version"))
_QUIET_GIT = (
    *("-c", "core.fsmonitor=false", "-c", "core.hooksPath=/dev/null"),
    *("--no-optional-locks", "--no-pager"),
)

Entry: TypeAlias = Mapping[str, Any]


@dataclass(frozen=True)
class VersionsOptions:
    """The ``versions`` block."""

    every_s: float | None = option(
        None, "look again at this interval; only at the start when absent", unit="s"
    )
    python: Mapping[str, str] = option(
        {}, "names and folders of Python environments whose packages are listed"
    )
    debian: Sequence[str] = option((), "Debian packages, by name or pattern")
    git: Mapping[str, str] = option({}, "names and folders of git working trees")
    ros: Sequence[str] = option(
        (), "folders with ROS packages: installed or workspaces; /opt/ros/* when absent"
    )
    topics: Sequence[TopicOptions] = option((), "kinds to record; all when absent")

    def in_folder(self, folder: Path) -> VersionsOptions:
        """Return the same with paths seen from a folder."""

        def seen(path: str) -> str:
            return str(folder / Path(path).expanduser())

        return replace(
            self,
            python={name: seen(path) for name, path in self.python.items()},
            git={name: seen(path) for name, path in self.git.items()},
            ros=[seen(path) for path in self.ros],
        )

    def check(self) -> Iterator[tuple[str, str]]:
        """Yield each option with an invalid value, and why; reads nothing."""
        if self.every_s is not None and not 1 <= self.every_s < float("inf"):
            yield "every_s", "must be 1 s or more"
        for name in self.debian:
            if not re.fullmatch(r"[a-z0-9*?\[\]][a-z0-9+.:*?\[\]-]*", name):
                yield "debian", f"'{name}' is no name or pattern of a package"
        yield from unknown_topics(self.topics, KINDS)


Config = VersionsOptions


class VersionsSource:
    """Records the versions of this computer once per run, and again when asked to."""

    lossless = False

    def __init__(self, config: VersionsOptions, name: str) -> None:
        self.config = config
        self.name = name

    def topics(self) -> Sequence[TopicOptions]:
        return self.config.topics

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Look at the start and every ``every_s``, then wait for ``stop``."""
        look = _Look(self.config, sink, stop)
        while not stop.is_set():
            look.step()
            stop.wait(self.config.every_s)
        look.end()


Source = VersionsSource


class _Look:
    """What was found last, to find changes; also of the last run."""

    def __init__(self, config: VersionsOptions, sink: Sink, stop: threading.Event) -> None:
        self.config = config
        self.sink = sink
        self._stop = stop
        self._known = {
            kind: {str(name): str(version) for name, version in found.items()}
            for kind, found in sink.state().items()
            if isinstance(found, dict)
        }
        self._troubles: dict[str, str] = {}
        self._up: set[str] = set()

    def step(self) -> None:
        """Read each kind; one that cannot be read keeps what was known of it."""
        wanted = [topic.name for topic in self.config.topics] or KINDS
        for kind in wanted:
            if self._stop.is_set():
                return
            unread: dict[str, str] = {}
            try:
                entries = list(islice(self._entries(kind, unread), MOST + 1))
            except (AmberboxError, OSError, ValueError, RecursionError) as error:
                self._trouble(kind, f"cannot be read: {' '.join(str(error).split())}")
                continue
            if len(entries) > MOST:
                entries = entries[:MOST]
                unread[""] = f"only the first {MOST} are recorded"
            self._trouble(kind, "; ".join(unread.values()))
            if entries or kind in self._known:
                self._record(kind, entries, unread)

    def end(self) -> None:
        """Report the links as down."""
        for kind in sorted(self._up):
            self.sink.link_down(kind, PEER, "stopped")

    def _entries(self, kind: str, unread: dict[str, str]) -> Iterator[Entry]:
        """Yield what is found; environments and trees that cannot be read go to ``unread``."""
        match kind:
            case "system":
                yield from _system()
            case "amberbox":
                yield {"name": "amberbox", "version": __version__}
                yield {"name": "python", "version": platform.python_version()}
            case "python":
                yield from _python_packages(self.config.python, unread)
            case "debian":
                yield from _debian_packages(self.config.debian, self._stop)
            case "git":
                yield from _working_trees(self.config.git, unread, self._stop)
            case "containers":
                yield from _containers()
            case _:
                yield from _ros_packages(self.config.ros)

    def _trouble(self, kind: str, text: str) -> None:
        """Report what is missing, once; an empty text ends it."""
        if self._troubles.get(kind, "") == text:
            return
        self._troubles[kind] = text
        if text:
            self.sink.event("versions_incomplete", f"{kind}: {text}", group=kind)

    def _record(self, kind: str, entries: Sequence[Entry], unread: Mapping[str, str]) -> None:
        before = self._known.get(kind)
        kept = {
            label: version
            for label, version in (before or {}).items()
            if any(label == name or label.endswith(f" ({name})") for name in unread)
        }
        found = kept | {_label(entry): _short(entry) for entry in entries}
        text = msgspec.json.encode(sorted(found.items()))
        row = {
            "count": len(entries),
            "digest": hashlib.sha256(text).hexdigest()[:16],
            "entries": entries,
        }
        stream = self.sink.topic(Topic(kind, "json"))
        if kind not in self._up:
            self._up.add(kind)
            self.sink.link_up(kind, PEER)
        self.sink.message(stream, msgspec.json.encode(row), self.sink.now_ns())
        if before is not None:
            self._report_changes(kind, before, found)
        if before != found:
            self._known[kind] = found
            self.sink.save_state(self._known)

    def _report_changes(
        self, kind: str, before: Mapping[str, str], after: Mapping[str, str]
    ) -> None:
        names = [
            name
            for name in sorted({*before, *after})
            if before.get(name) != after.get(name)
        ]  # fmt: skip
        for name in names[:_MOST_EVENTS]:
            old, new = before.get(name), after.get(name)
            if old is None:
                text = f"{name} {new} is new"
            elif new is None:
                text = f"{name} {old} is gone"
            else:
                text = f"{name} {old} -> {new}"
            details = {"group": kind, "name": name, "before": old, "after": new}
            self.sink.event("version_changed", text, **details)
        if len(names) > _MOST_EVENTS:
            rest = f"{kind}: {len(names) - _MOST_EVENTS} more have changed"
            self.sink.event("version_changed", rest, group=kind)


def _label(entry: Entry) -> str:
    """Return what an entry is called in a text, unique within its kind."""
    place = entry.get("environment", "")
    return f"{entry['name']} ({place})" if place else entry["name"]


def _short(entry: Entry) -> str:
    """Return the version as one would say it."""
    if "commit" not in entry:
        return str(entry["version"])
    text = f"{entry['commit'][:12]} ({entry['branch'] or 'no branch'})"
    return f"{text}, changed" if entry["dirty"] else text


def _cut(text: str) -> str:
    return " ".join(text.split())[:_LONGEST]


def _system() -> Iterator[Entry]:
    release = {}
    with suppress(OSError):
        release = platform.freedesktop_os_release()
    yield {"name": "os", "version": _cut(release.get("PRETTY_NAME", platform.system()))}
    yield {"name": "kernel", "version": _cut(platform.release())}
    yield {"name": "machine", "version": _cut(platform.machine())}
    yield {"name": "hostname", "version": _cut(platform.node())}


def _python_packages(environments: Mapping[str, str], unread: dict[str, str]) -> Iterator[Entry]:
    """Yield the packages of environments by the names of their metadata; runs nothing of them."""
    for name, folder in environments.items():
        root = Path(folder)
        places = [
            *root.glob("lib/python3*/site-packages"),
            *root.glob("lib/python3*/dist-packages"),
            *root.glob("local/lib/python3*/dist-packages"),
        ]
        if not places and not root.is_dir():
            unread[name] = f"there is no environment {folder}"
            continue
        seen = set()
        for path in sorted(path for place in places or [root] for path in place.iterdir()):
            package = _python_package(path)
            if package is not None and package not in seen:
                seen.add(package)
                yield {"name": package[0], "version": package[1], "environment": name}


def _python_package(path: Path) -> tuple[str, str] | None:
    """Return name and version of the package that a path is the metadata of."""
    if path.suffix not in (".dist-info", ".egg-info"):
        return None
    name, _, version = path.stem.partition("-")
    if path.suffix == ".egg-info":
        version = version.partition("-py")[0]
        if not version and path.is_dir():  # as linked by colcon and 'setup.py develop'
            with suppress(OSError, KeyError, ValueError):
                version = PathDistribution(path).version
    return _cut(name), _cut(version or "")


def _debian_packages(patterns: Sequence[str], stop: threading.Event) -> Iterator[Entry]:
    if not patterns:
        return
    form = "${binary:Package}\\t${Version}\\t${db:Status-Abbrev}\\n"
    status, text = _output(["dpkg-query", "--show", f"--showformat={form}", "--", *patterns], stop)
    if status not in (0, 1):  # 1: some pattern fits nothing
        raise AmberboxError(f"dpkg-query ended with status {status}")
    for line in sorted(text.splitlines()):
        name, _, rest = line.partition("\t")
        version, _, state = rest.partition("\t")
        if state[1:2] == "i":
            yield {"name": _cut(name), "version": _cut(version)}


def _working_trees(
    folders: Mapping[str, str], unread: dict[str, str], stop: threading.Event
) -> Iterator[Entry]:
    for name, folder in folders.items():
        try:
            commit, branch = _head(Path(folder))
        except (AmberboxError, OSError) as error:
            unread[name] = str(error)
            continue
        dirty, why = _is_dirty(folder, stop)
        yield {
            "name": name,
            "version": commit[:12],
            "commit": commit,
            "branch": branch,
            "dirty": dirty,
            "why": why,
            "folder": _cut(folder),
        }


def _head(folder: Path) -> tuple[str, str]:
    """Return commit and branch from git's files, whoever owns them; no program is run."""
    git = folder / ".git"
    if git.is_file():  # a linked working tree or a submodule
        git = folder / _read(git).removeprefix("gitdir:").strip()
    if not (git / "HEAD").is_file():
        raise AmberboxError(f"{folder} is no git working tree")
    head = _read(git / "HEAD").strip()
    if not head.startswith("ref: "):
        return _checked(head, folder), ""
    ref = head.removeprefix("ref: ")
    common = git
    with suppress(FileNotFoundError):
        common = git / _read(git / "commondir").strip()
    is_branch = re.fullmatch(r"refs/[^\0]+", ref) and ".." not in ref
    if not is_branch:
        raise AmberboxError(f"HEAD of {folder} is '{_cut(ref)}', which is no branch")
    branch = _cut(ref.removeprefix("refs/heads/"))
    for place in (git, common):
        with suppress(FileNotFoundError):
            return _checked(_read(place / ref).strip(), folder), branch
    with suppress(FileNotFoundError):
        for line in _read(common / "packed-refs", _REFS_BYTES).splitlines():
            if line.endswith(f" {ref}"):
                return _checked(line.partition(" ")[0], folder), branch
    return "", branch  # no commit yet


def _checked(commit: str, folder: Path) -> str:
    if not _COMMIT.fullmatch(commit):
        raise AmberboxError(f"'{_cut(commit)}' in {folder} is no commit")
    return commit


def _read(path: Path, most: int = _FILE_BYTES) -> str:
    with path.open("rb") as file:
        return file.read(most).decode(errors="replace")


def _is_dirty(folder: str, stop: threading.Event) -> tuple[bool | None, str]:
    """Ask git whether tracked files have changed; unknown, with the reason, where it refuses.

    Git trusts the working trees of this user only: the configuration of others names programs.
    """
    command = ["git", *_QUIET_GIT, "-C", folder, "status", "--porcelain", "--untracked-files=no",
               "--ignore-submodules=all"]  # fmt: skip
    try:
        status, text = _output(command, stop)
    except AmberboxError as error:
        return None, error.what
    if status:
        return None, "git refuses; the folder may belong to another user"
    return bool(text.strip()), ""


def _containers() -> Iterator[Entry]:
    for path in engine_sockets():
        for found in ask_engine(path, "/containers/json?all=true") or ():
            if not isinstance(found, dict):
                continue
            names = found.get("Names")
            first = names[0] if isinstance(names, list) and names else found.get("Id", "")
            image, identity = str(found.get("Image", "")), str(found.get("ImageID", ""))
            short = identity.removeprefix("sha256:")[:12]
            yield {
                "name": _cut(str(first).lstrip("/")),
                "version": _cut(f"{image} {short}" if short else image),
                "image": _cut(image),
                "image_id": _cut(identity),
                "state": _cut(str(found.get("State", ""))),
            }


def _ros_packages(folders: Sequence[str]) -> Iterator[Entry]:
    """Yield ROS packages by their ``package.xml``; the first folder that has a package counts."""
    seen = set()
    for root in map(Path, folders) if folders else sorted(Path("/opt/ros").glob("*")):
        if folders and not root.is_dir():
            raise AmberboxError(f"there is no folder {root}")
        for pattern in ("share/*/package.xml", "*/package.xml", "*/*/package.xml"):
            for path in sorted(root.glob(pattern)):
                text = _read(path)
                name, version = _NAME.search(text), _VERSION.search(text)
                if name and version and name[1] not in seen:
                    seen.add(name[1])
                    yield {"name": _cut(name[1]), "version": _cut(version[1]), "folder": str(root)}


def _output(command: Sequence[str], stop: threading.Event) -> tuple[int, str]:
    """Run a program; return its status and output.

    Raises AmberboxError if it cannot be started, takes too long or prints too much.
    """
    environment = {
        **{key: os.environ[key] for key in ("PATH", "HOME") if key in os.environ},
        "LC_ALL": "C",
        "GIT_CONFIG_NOSYSTEM": "1",
        "GIT_CONFIG_GLOBAL": os.devnull,
        "GIT_TERMINAL_PROMPT": "0",
    }
    name = command[0]
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
        )
    except OSError as error:
        raise AmberboxError(f"{name} cannot be started: {error.strerror}") from error
    assert process.stdout is not None
    data, until_s = b"", time.monotonic() + _WAIT_S
    try:
        while True:
            if stop.is_set() or time.monotonic() > until_s:
                raise AmberboxError(f"{name} has no answer within {_WAIT_S:g} s")
            if not select.select([process.stdout], (), (), 0.1)[0]:
                continue
            block = os.read(process.stdout.fileno(), 1 << 16)
            if not block:
                return process.wait(timeout=_WAIT_S), data.decode(errors="replace")
            data += block
            if len(data) > _OUTPUT_BYTES:
                raise AmberboxError(f"{name} prints more than {_OUTPUT_BYTES} bytes")
    except subprocess.TimeoutExpired as error:
        raise AmberboxError(f"{name} does not end") from error
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
