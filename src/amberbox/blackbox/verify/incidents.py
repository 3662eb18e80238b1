"""Check the incidents: what is kept, and why, against what the keeper wrote into the manifest."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any

import msgspec

from amberbox.blackbox.incidents.incident import (
    FILE,
    RING,
    Incident,
    folder_of,
    from_line,
    load_all,
    same_window,
)
from amberbox.blackbox.segments.manifest import Manifest
from amberbox.blackbox.store import INCIDENTS, Store
from amberbox.blackbox.verify.findings import Finding, State
from amberbox.blackbox.verify.place import TROUBLE


def check_incidents(store: Store, known: Manifest) -> Iterator[tuple[str, list[Finding]]]:
    """Give each incident's file and what is wrong with it, and what is missing of its ring."""
    folders = {path.parent.name for path in (store.path / INCIDENTS).glob(f"[!.]*/{FILE}")}
    released = {incident.id for incident in load_all(store) if not incident.is_pinned}
    for incident_id in sorted(folders | known.incidents.keys()):
        line = known.incidents.get(incident_id)
        name = f"{INCIDENTS}/{incident_id}/{FILE}"
        yield name, list(_check(store, incident_id, name, line))
        held = line if line is not None and incident_id not in released else None
        for lost in _lost_ring(store, held) if held is not None else ():
            yield lost, [Finding("missing", lost, "is gone: the incident held it")]


def _check(
    store: Store, incident_id: str, name: str, line: Mapping[str, Any] | None
) -> Iterator[Finding]:
    said = _said(line)
    try:
        content = (folder_of(store, incident_id) / FILE).read_bytes()
        found = msgspec.json.decode(content, type=Incident)
        document = msgspec.json.decode(content)
    except FileNotFoundError:
        if said is not None and said.is_pinned:
            yield _finding("missing", name, f"is gone: {said.text or 'no reason given'}", said)
        return
    except (msgspec.MsgspecError, UnicodeDecodeError):
        yield _finding("damaged", name, "cannot be read; the manifest says what it holds", said)
        return
    plain = msgspec.json.format(msgspec.json.encode(document), indent=2)
    if not document.keys() <= {f.name for f in fields(Incident)} or plain != content:
        yield _finding("damaged", name, "is not as it was written", said)
        return
    yield from _compare(name, found, said, line or {})


def _compare(
    name: str, found: Incident, said: Incident | None, line: Mapping[str, Any]
) -> Iterator[Finding]:
    if said is None:
        yield _finding("unsigned", name, "no line of the manifest speaks of it yet", found)
        return
    before = (said.reasons, said.made_ns, said.versions)
    if (found.reasons[: len(said.reasons)], found.made_ns, found.versions) != before:
        yield _finding("altered", name, "reasons or versions are not those written down", said)
    elif found.told != found.state:
        yield _finding("unsigned", name, "was changed after it was written down last", found)
    elif not same_window(found, said) or line.get("bytes", found.bytes) != found.bytes:
        yield _finding("altered", name, "is not as it was written down in the manifest", said)


def _said(line: Mapping[str, Any] | None) -> Incident | None:
    try:
        return None if line is None else from_line(line)
    except TROUBLE:
        return None


def _lost_ring(store: Store, line: Mapping[str, Any]) -> Iterator[str]:
    """Name the ring's journals that an incident held when it was complete."""
    about = line["incident"]
    for name in line.get("ring", ()) if about["state"] == "complete" else ():
        if not (folder_of(store, about["id"]) / RING / name).exists():
            yield f"{INCIDENTS}/{about['id']}/{RING}/{name}"


def _finding(state: State, name: str, text: str, about: Incident | None) -> Finding:
    if about is None:
        return Finding(state, name, text)
    return Finding(state, name, text, from_ns=about.from_ns, to_ns=about.to_ns)
