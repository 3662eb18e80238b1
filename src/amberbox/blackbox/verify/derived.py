"""Check the small files beside the record, and list the files that nothing vouches for."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from fnmatch import fnmatch
from pathlib import Path

from amberbox.blackbox.journal import head
from amberbox.blackbox.recorder.names import (
    NAMES,
    names_text,
    new_names,
    recorded_names,
    stated_names,
    wrong_names,
)
from amberbox.blackbox.segments.manifest import Manifest
from amberbox.blackbox.signing.keys import PRIVATE, PUBLIC, is_private_key
from amberbox.blackbox.store import FOLDERS, IDENTITY, INCIDENTS, Store, identity_text, stated_id
from amberbox.blackbox.verify.findings import Finding

Found = Iterator[tuple[str, list[Finding]]]
NOT_SIGNED = "not covered by what this store signed"
_REASONS = (
    (NAMES, NOT_SIGNED),
    ("run", "the number of the last run: a wrong one at most skips numbers"),
    (f"*/{head.NAME}", "a hint for those who follow live: its next write replaces it"),
    ("heads.json", NOT_SIGNED),
    (PRIVATE, "the private key: nobody can tell without its public half"),
    (PUBLIC, "there is no signature to check it with"),
    ("room", "how much room there is: measured anew every few seconds"),
    ("reserve", "room for the last events: what is in it means nothing"),
    ("full", "why only events are recorded now: stated anew by the keeper"),
    ("lock.*", "who writes right now"),
    ("state/*", "what a source remembers: without it the source finds out anew"),
    ("requests/*", "asked for, not yet written down by the keeper"),
    ("importing/*", "an import that is under way or was broken off: no part of the record yet"),
    ("link*", "what the link to a server remembers"),
    ("docked", "what the link to a server remembers"),
    ("run.json", "what the processes of the robot are doing now"),
    ("segments/*", "no line of the manifest tells of it: no part of the record"),
    ("incidents/*", "no line of the manifest tells of it yet"),
    ("*.part", "left by a process that was killed while it wrote"),
    ("*.tmp", "left by a process that was killed while it wrote"),
    ("*", "no part of the record"),
)
"""Why a file is not covered, by pattern; the first that fits counts."""


def check_derived(store: Store, known: Manifest, public: str) -> Found:
    """Give the files whose content follows from others, and what is wrong with them.

    ``public`` is the key that is believed (hex; empty for none).
    """
    yield IDENTITY, list(_identity(store))
    if known.names or (store.path / NAMES).exists():
        yield NAMES, list(_names(store.path, known))
    for folder in FOLDERS.values():
        path = store.path / folder / head.NAME
        if path.exists():
            yield f"{folder}/{head.NAME}", list(_head(store, path))
    yield from _others(store, public)


def _others(store: Store, public: str) -> Found:
    run, key = store.path / "run", store.path / PRIVATE
    if run.exists():
        yield "run", list(_run(store, run))
    holds = is_private_key(public, store.path) if public and key.exists() else None
    if holds is not None:
        text = "cannot be read, or is not the key that signed"
        yield PRIVATE, [] if holds else [Finding("damaged", PRIVATE, text)]
    for path in sorted((store.path / "requests").glob("*.json")):
        name = f"requests/{path.name}"
        if not _is_json(path):
            yield name, [Finding("damaged", name, "cannot be read")]


def _identity(store: Store) -> Iterator[Finding]:
    path = store.path / IDENTITY
    if not path.exists():
        yield Finding("missing", IDENTITY, f"is gone; the journals name {store.id}")
    elif not stated_id(store.path):
        yield Finding("damaged", IDENTITY, f"cannot be read; the journals name {store.id}")
    elif json.loads(path.read_text()) != json.loads(identity_text(store.id)):
        yield Finding("damaged", IDENTITY, "does not say what it was written with")


def _names(store: Path, known: Manifest) -> Iterator[Finding]:
    stated = stated_names(store)
    if not (store / NAMES).exists():
        yield Finding("missing", NAMES, f"is gone: it held the names of {len(known.names)} items")
    elif stated is None:
        yield Finding("damaged", NAMES, "cannot be read; the record tells the names of its items")
    else:
        wrong = wrong_names(stated, recorded_names(store))
        foreign = stated.keys() - known.names.keys() - new_names(stated, known.names).keys()
        if wrong:
            text = f"does not name {', '.join(sorted(wrong.values()))} as the record does"
            yield Finding("altered", NAMES, text)
        elif foreign:
            text = f"gives a name that another topic has: {', '.join(sorted(foreign))}"
            yield Finding("altered", NAMES, text)
        elif (store / NAMES).read_text() != names_text(stated):
            yield Finding("damaged", NAMES, "is not as it was written")
        elif known.names and new_names(stated, known.names):
            yield Finding("unsigned", NAMES, "has names that the keeper has not signed yet")


def _head(store: Store, path: Path) -> Iterator[Finding]:
    name = f"{path.parent.name}/{path.name}"
    found = head.read_head(path.parent) or head.read_head(path.parent)  # written just then
    if found is None:
        yield Finding("damaged", name, "its checksum does not hold; its next write replaces it")
    elif found.store_id != store.id:
        yield Finding("altered", name, f"is that of another store ({found.store_id})")
    elif not head.is_padded(path.parent):
        yield Finding("damaged", name, "bytes after its content are not as they were written")


def _run(store: Store, path: Path) -> Iterator[Finding]:
    try:
        stated = int(path.read_text())
    except (OSError, ValueError):
        yield Finding("damaged", "run", "is no number; the journals tell the last run")
        return
    last = max(store.runs(), default=0)
    if stated < last:
        yield Finding("damaged", "run", f"says {stated}, but there is a run {last}")


def _is_json(path: Path) -> bool:
    try:
        return isinstance(json.loads(path.read_text()), dict)
    except FileNotFoundError:  # seen to meanwhile
        return True
    except (OSError, ValueError):
        return False


def uncovered(store: Store, covered: Collection[str], known: Manifest) -> dict[str, str]:
    """Return why each file of a store is not covered that was not checked against anything."""
    found = {}
    names = {path.relative_to(store.path).as_posix() for path in _all(store.path)}
    for folder in FOLDERS.values():
        if any(name.startswith(f"{folder}/") for name in names):
            names.add(f"{folder}/{head.NAME}")
    for name in sorted(names - set(covered)):
        if fnmatch(name, f"{INCIDENTS}/*/ring/*") and f"ring/{Path(name).name}" in covered:
            continue  # the same file by two names
        found[name] = next(reason for pattern, reason in _REASONS if fnmatch(name, pattern))
    for name in covered:
        if fnmatch(name, "ring/*.mcap") or fnmatch(name, f"{INCIDENTS}/*/ring/*"):
            found[name] = "of the ring: its own checksums hold, but nothing tells where it ended"
    if NAMES in covered and not known.names:
        found[NAMES] = NOT_SIGNED
    return found


def _all(store: Path) -> Iterator[Path]:
    for path in store.rglob("*"):
        if path.is_file():
            yield path
