"""No false alarm: for any history of a robot, verify finds it intact or unsigned at its end."""

from __future__ import annotations

import random
import threading
from pathlib import Path

import pytest

from amberbox.blackbox.recorder.pipeline import PipelineOptions
from amberbox.blackbox.retention.maintenance import RetentionService
from amberbox.blackbox.robot_folder.robot_yaml import RetentionOptions
from amberbox.blackbox.signing.findings import VerifyReport
from amberbox.blackbox.signing.signatures import Signer
from amberbox.blackbox.signing.verify import verify
from amberbox.blackbox.store import manifest as mf
from amberbox.blackbox.store.manifest import condense
from amberbox.blackbox.store.store import open_store
from amberbox.core.clock import NS
from amberbox.testing.clock import ManualClock
from tests.blackbox.signing.conftest import Robot, keep
from tests.support.manual_recorder import COUNT, History, ManualBox, number

STORES = 8
"""A thousand of them live through ``python -m benchmarks.soak_verify``."""


@pytest.mark.parametrize("seed", range(STORES))
def test_a_random_life_raises_no_alarm(tmp_path: Path, seed: int) -> None:
    history = History(tmp_path / "store", seed)
    history.live()
    report = verify(history.path)
    assert report.is_good(), (history.events, bad(report))


def test_random_lives_see_crashes_columns_and_deletion(tmp_path: Path) -> None:
    """What the test above is worth."""
    seen: set[str] = set()
    for seed in (1, 2, 3, 5):
        history = History(tmp_path / f"store-{seed}", seed)
        store = history.live()
        known = mf.read(store.path)
        seen |= {event.split()[0] for event in history.events}
        seen |= {"tombstones"} if known.tombstones else set()
        seen |= {"segments"} if known.segments else set()
    assert {"crash", "close", "step", "tombstones", "segments"} <= seen


def test_a_robot_that_records_is_verified_without_alarm(tmp_path: Path) -> None:
    box = ManualBox(tmp_path / "store", options=PipelineOptions(rotate_ns=NS))
    keeper = RetentionService(open_store(box.store), RetentionOptions(quota=10**9, min_free=0))
    for n in range(40):
        box.hear(COUNT, number(n))
        box.write()
        if n % 5 == 4:
            for mark in box.pipeline.mark_sync():
                mark.wait()
            keeper.step(threading.Event())
            assert bad(verify(box.store)) == []
    box.close()


def test_the_manifest_condensed_still_knows_the_old_head(robot: Robot) -> None:
    keep(robot.path)
    head = next(h.hash for h in robot.verify().heads if h.what == "manifest")
    store, notary = open_store(robot.path), Signer(open_store(robot.path))
    content = (robot.path / mf.NAME).read_bytes()
    gone = {"kind": "confirmed", "journals": ["journal/gone"], "by": "", "at_ns": 0}
    mf.append(store.path, [gone] * 2000)  # what says nothing of what is there any more goes
    notary.sign()
    newest = next(h.hash for h in robot.verify().heads if h.what == "manifest")
    assert condense(store.path, lambda name: (store.path / name).exists(), notary.signature_of, 1)
    notary.sign()
    assert len((robot.path / mf.NAME).read_bytes()) < len(content) + 100_000
    assert robot.bad(newest) == []
    assert [f.state for f in robot.bad(head)] == ["missing"], "that line is gone for good"


@pytest.mark.parametrize("seed", range(8))
def test_a_power_cut_is_never_taken_for_tampering(tmp_path: Path, seed: int) -> None:
    """Unsynced data may be cut off or zero, although no one has altered them."""
    rng = random.Random(seed)
    clock = ManualClock()
    box = ManualBox(tmp_path / "store", clock=clock)
    keep(box.store, close=False)
    synced = 0
    for n in range(rng.randint(5, 40)):
        box.hear(COUNT, *(number(n * 20 + k) for k in range(20)))
        box.write()
        if n % 4 == 3:
            for mark in box.pipeline.mark_sync():
                mark.wait()
            synced = box.pipeline.journal_paths[0].stat().st_size
            keep(box.store, close=False)
    path = box.pipeline.journal_paths[0]
    box.crash()
    tear(path, synced, rng)
    states = {f.state for f in verify(box.store).findings}
    assert states <= {"unsigned", "damaged"}, bad(verify(box.store))
    after = ManualBox(box.store, clock=clock)
    after.hear(COUNT, number(1))
    after.write()
    after.close()
    keep(box.store)
    states = {f.state for f in verify(box.store).findings}
    assert states <= {"unsigned", "damaged"}, bad(verify(box.store))


def tear(path: Path, synced: int, rng: random.Random) -> None:
    """Leave a file as a power cut may: all that was synced, of the rest a part or zeros."""
    content = path.read_bytes()
    rest = bytearray(content[synced:])
    if rng.random() < 0.5:
        del rest[rng.randint(0, len(rest)) :]
    elif rest:
        start = rng.randrange(len(rest))
        rest[start:] = bytes(len(rest) - start)
    path.write_bytes(content[:synced] + rest)


def bad(report: VerifyReport) -> list[tuple[str, str, str]]:
    return [(f.state, f.file, f.text) for f in report.findings if f.state != "unsigned"]
