"""Real processes: found by name, script or command line, and their usage."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from amberbox.core.errors import UsageError
from amberbox.monitoring.probes.process import ProcessUsage, find, judge, measure, usage
from amberbox.testing.clock import wait_until

PROC = Path("/proc")
Start = Callable[..., "subprocess.Popen[bytes]"]


@pytest.fixture
def start() -> Iterator[Start]:
    running: list[subprocess.Popen[bytes]] = []

    def start_one(*command: str) -> subprocess.Popen[bytes]:
        running.append(subprocess.Popen(command, stdout=subprocess.PIPE))
        return running[-1]

    yield start_one
    for process in running:
        process.kill()
        process.wait()


def script(folder: Path, name: str, code: str) -> Sequence[str]:
    path = folder / name
    path.write_text(code)
    return [sys.executable, "-u", str(path), "--name", "amber_x"]


def test_a_program_is_found_by_its_name_while_it_runs(tmp_path: Path, start: Start) -> None:
    program = tmp_path / "laser_driver_amber"
    shutil.copy2(shutil.which("sleep") or "/bin/sleep", program)
    assert measure("laser_driver_amber")["ok"] is False
    first, second = start(str(program), "60"), start(str(program), "60")
    wait_until(lambda: len(find(PROC, "laser_driver_amber")) == 2, "both run")
    found = measure("laser_driver_amber")
    assert (found["ok"], found["count"]) == (True, 2)
    assert 0.1 < found["rss_mb"] < 100
    assert found["cpu_percent"] < 50
    for process in (first, second):
        process.kill()
        process.wait()
    assert measure("laser_driver_amber") == {
        "ok": False,
        "count": 0,
        "cpu_percent": None,
        "rss_mb": None,
    }


def test_a_busy_script_is_found_by_its_file_or_command_line(tmp_path: Path, start: Start) -> None:
    busy = start(*script(tmp_path, "planner_amber.py", "print(1)\nwhile True: pass"))
    assert busy.stdout is not None
    busy.stdout.readline()
    assert find(PROC, "planner_amber.py") == [busy.pid]
    assert find(PROC, "*planner_amber.py --name amber_?") == [busy.pid]
    assert find(PROC, "planner_amber") == []
    assert find(PROC, "amber_x") == [], "an argument is no name"
    assert measure("planner_amber.py")["cpu_percent"] > 2


def test_a_process_that_is_dead_but_not_buried_does_not_count(start: Start) -> None:
    process = start("sleep", "60")
    process.send_signal(signal.SIGKILL)
    stat = PROC / str(process.pid) / "stat"
    wait_until(lambda: ") Z " in stat.read_text(), "the process is a zombie")
    assert usage(PROC, [process.pid]) == {}


def test_what_is_used_is_the_difference_of_two_looks() -> None:
    before = {1: ProcessUsage(10.0, 5.0), 2: ProcessUsage(1.0, 1.0)}
    after = {1: ProcessUsage(10.25, 6.0), 3: ProcessUsage(0.5, 2.0)}
    assert judge(before, after, 0.5) == {
        "ok": True,
        "count": 2,
        "cpu_percent": 50.0,
        "rss_mb": 8.0,
    }


def test_a_name_with_brackets_and_spaces_is_read(tmp_path: Path) -> None:
    numbers = " ".join(["S", *["0"] * 10, "150", "50", *["0"] * 8, "1000", "0"])
    (tmp_path / "7").mkdir()
    (tmp_path / "7" / "stat").write_text(f"7 (a) Z (b) {numbers}\n")
    tick, page = os.sysconf("SC_CLK_TCK"), os.sysconf("SC_PAGE_SIZE")
    assert usage(tmp_path, [7, 8]) == {7: ProcessUsage(200 / tick, page * 1000 / 1e6)}


def test_where_others_are_hidden_a_missing_process_is_unknown(tmp_path: Path) -> None:
    with pytest.raises(PermissionError, match="hidepid"):
        find(tmp_path, "laser_driver")
    (tmp_path / "1").mkdir()
    assert find(tmp_path, "laser_driver") == []


def test_a_kernel_thread_goes_by_its_own_name(tmp_path: Path) -> None:
    for pid, name in ((1, "systemd"), (9, "irq/35-can0")):
        (tmp_path / str(pid)).mkdir()
        (tmp_path / str(pid) / "cmdline").write_text("")
        (tmp_path / str(pid) / "comm").write_text(f"{name}\n")
    assert find(tmp_path, "irq/35-can0") == [9]


def test_no_name_is_refused() -> None:
    with pytest.raises(UsageError, match="no process is named"):
        find(PROC, " ")
