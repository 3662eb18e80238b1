"""``amberbox link`` as a process, killed repeatedly: the server's data have no gap."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.agent.doctor.processes import LINK_LOCK, judged_link, link, link_in_words
from amberbox.agent.doctor.subject import HostSystem, subject
from amberbox.agent.join import write_key
from amberbox.agent.link import LinkState, write_state
from amberbox.blackbox.store.journal_reader import journals
from amberbox.blackbox.store.store import WriterLock, create_store, is_locked
from amberbox.cli.main import main
from amberbox.core.clock import NS
from amberbox.core.source import TopicOptions
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.support.manual_recorder import COUNT, ManualBox, number, raw_messages
from tests.support.processes import command, free_port

KEY = "abr_0123456789ab_" + "K" * 43


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A robot folder whose server does not answer."""
    port = free_port()
    (tmp_path / "robot.yaml").write_text(f"id: r1\nserver: {{url: 'http://127.0.0.1:{port}'}}\n")
    (tmp_path / "black_box.yaml").write_text("- ros: {topics: [{name: /count}]}\n")
    write_key(tmp_path, KEY)
    return tmp_path


@pytest.fixture
def started() -> Iterator[list[subprocess.Popen[bytes]]]:
    found: list[subprocess.Popen[bytes]] = []
    yield found
    for process in found:
        if process.poll() is None:
            process.kill()
        process.wait()


def start(folder: Path) -> subprocess.Popen[bytes]:
    return subprocess.Popen(command("link", "--quiet", folder), stdin=subprocess.DEVNULL)


def test_a_link_killed_20_times_leaves_no_gap(
    folder: Path, started: list[subprocess.Popen[bytes]]
) -> None:
    box = ManualBox(folder / "store", [TopicOptions("/count")])
    count, locked = 0, 0
    store = box.pipeline.store
    for kill in range(20):
        started.append(start(folder))
        end_s = time.monotonic() + (PATIENCE_S if kill < 3 else 0.15)  # some get to work
        while time.monotonic() < end_s and not is_locked(store, LINK_LOCK):
            box.hear(COUNT, number(count))
            box.write()
            count += 1
            time.sleep(0.005)
        locked += is_locked(store, LINK_LOCK)
        started[-1].send_signal(signal.SIGKILL)
        started[-1].wait()
    box.close()
    assert locked
    found = [int.from_bytes(m, "little") for m in raw_messages(folder / "store", "/count")]
    assert found == list(range(count)) and count > 20
    assert not [d for journal in journals(folder / "store") for d in journal.damage]


def test_it_ends_in_order_and_tells_how_it_is(
    folder: Path, started: list[subprocess.Popen[bytes]], capsys: pytest.CaptureFixture[str]
) -> None:
    store = create_store(folder / "store")
    process = start(folder)
    started.append(process)
    state = store.path / "link-state.json"
    wait_until(lambda: state.exists() and bool(json.loads(state.read_text())["trouble"]))
    [finding] = link(subject(folder), HostSystem())
    assert finding.level == "warn" and "no link to http://127.0.0.1" in finding.found
    assert main(["link", str(folder)]) == 2, "a second one is refused"
    assert "is being written by process" in capsys.readouterr().err
    process.terminate()
    assert process.wait(PATIENCE_S) == 0
    assert not is_locked(store, LINK_LOCK)
    [finding] = link(subject(folder), HostSystem())
    assert "nothing links this robot" in finding.found


@pytest.mark.parametrize(
    ("remove", "what"), [("server.key", "there is no key in"), ("robot.yaml", "names no server")]
)
def test_without_server_or_key_it_says_how_to_join(
    folder: Path, remove: str, what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / remove).unlink()
    assert main(["link", str(folder)]) == 2
    said = capsys.readouterr().err
    assert what in said and "amberbox join" in said


def test_the_doctor_says_how_the_link_is() -> None:
    now_ns = 1_800_000_000 * NS
    state = {"server": "https://f", "connected": True, "backlog": 0, "at_ns": now_ns}
    assert judged_link(state, now_ns, "").level == "ok"
    assert link_in_words(state, now_ns) == "linked to https://f"
    assert link_in_words({**state, "backlog": 12}, now_ns).endswith(
        "the newest 12 records are not acknowledged yet"
    )
    newer = link_in_words({**state, "unknown_frames": 3}, now_ns)
    assert newer == "linked to https://f, 3 frames of its newer version were ignored"
    late = judged_link(state, now_ns + 300 * NS, "")
    assert (late.level, late.found) == ("warn", "the link to https://f has said nothing for 5 min")
    cut = {**state, "connected": False, "trouble": "no way"}
    assert link_in_words(cut, now_ns) == "no link to https://f: no way"


def test_status_says_how_the_link_is(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store = create_store(folder / "store")
    main(["status", str(folder)])
    assert "link" not in capsys.readouterr().out
    lock = WriterLock(store, LINK_LOCK)
    write_state(store, LinkState("https://f", True, "", 0, 3, time.time_ns()))
    main(["status", str(folder)])
    lock.release()
    assert capsys.readouterr().out.endswith("\nlinked to https://f\n")
