"""Journals of incidents are sent first, including the ring's files that only incidents hold."""

from __future__ import annotations

import threading
from pathlib import Path

from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention.maintenance import RetentionService
from amberbox.blackbox.retention.pins import PinRequest, pin
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.signing.keys import public_key
from amberbox.blackbox.store.store import Store, open_store
from amberbox.core.clock import NS
from amberbox.core.source import TopicOptions
from amberbox.core.types import Schema, Topic
from amberbox.link.connection import LinkOptions
from amberbox.link.uploader import HttpTransport, JournalCopier
from amberbox.server.database import ServerDatabase
from amberbox.server.ingest.uploads import UploadService
from tests.server.offline.served import served
from tests.support.manual_recorder import COUNT, ManualBox, number

RING = Topic("/ring", "ros1", Schema("std_msgs/Int64", "ros1msg", b"int64 data\n"))
OPTIONS = RetentionOptions(quota_percent=100.0, min_free=0)


def recorded_with_incident(path: Path) -> Store:
    """Record for 60 s in files of 10 s; mark the stretch from 25 s to 35 s."""
    topics = [TopicOptions("/count"), TopicOptions("/ring", keep="ring")]
    box = ManualBox(
        path, topics, options=PipelineOptions(rotate_ns=10 * NS, ring_rotate_ns=10 * NS)
    )
    store = open_store(path)
    for step in range(600):
        box.hear(COUNT, number(step))
        box.hear(RING, number(step))
        box.write(0.1)
        if step == 350:
            pin(store, PinRequest(10.0, 0.0, "bump", "test"), OPTIONS)
    box.close()
    keeper = RetentionService(store, OPTIONS)
    keeper.step(threading.Event())
    keeper.close()
    return store


def test_incidents_are_copied_first_and_the_ring_s_files_with_them(tmp_path: Path) -> None:
    store = recorded_with_incident(tmp_path / "store")
    database = ServerDatabase(tmp_path / "server.db")
    upload_service = UploadService(
        tmp_path / "server", database, lambda r, s: public_key(store.path) or ""
    )
    with served(upload_service) as port:
        options = LinkOptions(f"http://127.0.0.1:{port}", "r1", "key-r1")
        copier = JournalCopier(store, options, HttpTransport(options, lambda: None))
        order = copier.waiting()
        sizes = [store.journal_path(name).stat().st_size for name in order]
        backlog = []
        while copier.step():
            backlog.append(copier.backlog_bytes)
    assert backlog[0] == sum(sizes) > backlog[-1] > 0 == copier.backlog_bytes
    main = [p.relative_to(store.path).as_posix() for p in store.journal_files("main")]
    rings = [name for name in order if name.startswith("ring/")]
    rest = [name for name in order if not name.startswith("ring/")]
    assert rings and order[: len(rings)] == rings
    assert set(rest[:2]) == set(main[2:4]) and set(main) <= set(rest)
    for name in order:
        here = tmp_path / "server" / "journals" / "r1" / store.id / name
        assert here.read_bytes() == store.journal_path(name).read_bytes()
    database.close()
