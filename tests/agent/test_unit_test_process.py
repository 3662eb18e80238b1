"""Unit tests of a robot in their process: bad ones end alone, what they begin ends with them."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from amberbox.agent.unit_tests import Progress, RunTask, UnitTestRun, collect
from amberbox.testing.clock import wait_until
from tests.support.unit_tests import run_tests, write_tests
from tests.support.zmq_robot import ACTIONS, boot_s, zmq_robot

DRIVES = """
@pytest.mark.risk("moves")
@pytest.mark.timeout_s({limit})
def test_drives(act):
    act("drive", distance_m=1)
def test_next(): pass
"""


def test_outcomes(tmp_path: Path) -> None:
    done = run_tests(write_tests(tmp_path, a='''
        @pytest.fixture
        def broken(): raise RuntimeError("no device")
        @pytest.fixture
        def leaves():
            yield
            raise RuntimeError("not put away")
        def test_passes(measure):
            """It passes.

            More words."""
            print("said")
            assert measure("length", 1.5, "m") == 1.5
        def test_fails(): assert 1 == 2, "too short"
        def test_error(broken): pass
        def test_left(leaves): pass
        def test_both(leaves): assert False, "first"
        def test_skipped(): pytest.skip("no arm")
        @pytest.mark.xfail(reason="known")
        def test_known(): assert False
        @pytest.mark.parametrize("n", [1, 2])
        def test_many(n): pass
        class TestGroup:
            def test_in(self): pass
    '''))  # fmt: skip
    assert done.outcomes == {
        "a.passes": "passed", "a.fails": "failed", "a.error": "error", "a.left": "error",
        "a.both": "error", "a.skipped": "skipped", "a.known": "skipped", "a.many-1": "passed",
        "a.many-2": "passed", "a.TestGroup.in": "passed",
    }  # fmt: skip
    passed, failed = done.results["a.passes"], done.results["a.fails"]
    assert passed.output == "said\n"
    assert [(m.name, m.value, m.unit) for m in passed.measurements] == [("length", 1.5, "m")]
    assert passed.began < passed.ended
    assert "too short" in failed.message and "test_a.py" in failed.details
    assert failed.output == ""
    assert done.results["a.both"].message == "AssertionError: first\nassert False; " + (
        "RuntimeError: not put away"
    )
    assert done.results["a.skipped"].message == "no arm"
    found = {test.name: test for test in done.found.tests}
    assert found["a.passes"].description == "It passes."
    assert "a.passes: teardown" in done.progress


def test_hostile_tests_end_alone(tmp_path: Path) -> None:
    """Each test that ends, blocks or floods the process is found out; those behind it run."""
    done = run_tests(write_tests(tmp_path, h="""
        def test_exits(): os._exit(0)
        def test_is_killed(): os.kill(os.getpid(), signal.SIGKILL)
        @pytest.mark.timeout_s(0.5)
        def test_loops():
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            while True: pass
        def test_multiplies():
            while True: os.fork()
        def test_prints():
            for _ in range(1600): os.write(1, b"x" * 65536)
            print("the end")
        def test_fills_the_memory():
            assert [bytearray(1 << 28) for _ in range(8)]
        def test_fills_the_disk(tmp_path):
            with open(tmp_path / "file", "wb") as file:
                file.truncate(1 << 40)
        def test_speaks_for_others(request):
            for value in request.config.stash._storage.values():
                if hasattr(value, "tell"):
                    value._lines.write(b'{"type": "ends", "outcome": "passed"}\\n' * 9)
                    value._lines.flush()
        @pytest.mark.timeout_s(0.5)
        def test_reports_without_end(request):
            for value in request.config.stash._storage.values():
                while hasattr(value, "tell"):
                    value._lines.write(b'{"type": "phase", "phase": "call"}\\n' * 999)
        def test_ends_pytest(): pytest.exit("enough")
        def test_unlinks_itself(): os.unlink(__file__)
        def test_last(): pass
    """))  # fmt: skip
    assert done.outcomes == {
        "h.exits": "killed", "h.is_killed": "killed", "h.loops": "timeout",
        "h.multiplies": "killed", "h.prints": "passed", "h.fills_the_memory": "failed",
        "h.fills_the_disk": "failed", "h.speaks_for_others": "killed",
        "h.reports_without_end": "timeout", "h.ends_pytest": "killed",
        "h.unlinks_itself": "passed", "h.last": "passed",
    }  # fmt: skip
    assert done.results["h.exits"].message == "its process ended with exit status 0"
    assert "SIGKILL" in done.results["h.is_killed"].message
    printed = done.results["h.prints"]
    assert printed.output.endswith("the end\n") and len(printed.output) <= 8192
    assert printed.left_out_bytes + len(printed.output) == 1600 * 65536 + len("the end\n")


def test_nothing_is_left_behind(tmp_path: Path) -> None:
    """Also a process with a session of its own, whose parent has ended, is killed at the end."""
    pid = tmp_path / "pid"
    run_tests(write_tests(tmp_path, d=f"""
        def test_daemon():
            if os.fork() == 0:
                os.setsid()
                if os.fork() == 0:
                    with open({str(pid)!r}, "w") as file: file.write(str(os.getpid()))
                    time.sleep(1000)
                os._exit(0)
            while not os.path.exists({str(pid)!r}) or not open({str(pid)!r}).read(): pass
    """))  # fmt: skip
    assert not Path("/proc", pid.read_text()).exists()


def test_files_that_cannot_be_imported_leave_the_others(tmp_path: Path) -> None:
    folder = write_tests(
        tmp_path, a="def test_a(): pass", exits="os._exit(7)", lacks="import nowhere",
        syntax="def f(:", risky='@pytest.mark.risk("movs")\ndef test_r(): pass',
        about='@pytest.mark.tests("no mode")\ndef test_r(): pass',
    )  # fmt: skip
    found = collect(folder)
    assert [test.name for test in found.tests] == ["a.a"]
    problems = {problem.file: problem for problem in found.problems}
    assert "exit status 7" in problems["tests/test_exits.py"].what
    assert "No module named 'nowhere'" in problems["tests/test_lacks.py"].what
    assert "SyntaxError" in problems["tests/test_syntax.py"].what
    assert problems["tests/test_risky.py"].what.endswith("did you mean 'moves'?")
    assert problems["tests/test_risky.py"].line == 3
    assert "test_about.py" in str(problems)
    assert run_tests(folder).outcomes == {"a.a": "passed"}


def test_a_conftest_that_fails_is_named(tmp_path: Path) -> None:
    folder = write_tests(tmp_path, a="def test_a(): pass")
    (folder / "tests" / "conftest.py").write_text("import nowhere\n")
    (problem,) = collect(folder).problems
    assert "No module named 'nowhere'" in problem.what


def test_an_abort_ends_the_run(tmp_path: Path) -> None:
    def abort(run: UnitTestRun, progress: Progress) -> None:
        if progress.text == "call":
            run.abort("enough")

    folder = write_tests(tmp_path, a="def test_a(): time.sleep(1000)\ndef test_b(): pass")
    done = run_tests(folder, abort)
    assert done.outcomes == {"a.a": "killed", "a.b": "skipped"}
    assert done.results["a.b"].message == "not run: enough"


def test_who_started_it_is_gone(tmp_path: Path) -> None:
    """Without its parent nothing goes on: the test, and what it has started."""
    pid = tmp_path / "pid"
    folder = write_tests(tmp_path, a=f"""
        def test_a():
            child = subprocess.Popen(["sleep", "1000"], start_new_session=True)
            with open({str(pid)!r}, "w") as file: file.write(str(child.pid))
            time.sleep(1000)
    """)  # fmt: skip
    run = UnitTestRun(RunTask(str(folder)))
    wait_until(lambda: pid.exists() and pid.read_text())
    run._orders.close()
    wait_until(lambda: not Path("/proc", pid.read_text()).exists(), "the end of the test's child")
    run.close()


def test_an_action_is_done_by_a_test_of_its_risk(tmp_path: Path) -> None:
    with zmq_robot() as robot:
        folder = write_tests(tmp_path, a="""
            @pytest.mark.risk("state")
            def test_lights(act): assert act("light")["ok"]
            def test_only_reads(act): act("light")
            @pytest.mark.risk("state")
            def test_moves(act): act("drive", distance_m=1)
            @pytest.mark.risk("moves")
            def test_too_far(act): act("drive", distance_m=3)
            def test_typo(act): act("lihgt")
        """)  # fmt: skip
        (folder / "actions").mkdir()
        (folder / "actions" / "a.yaml").write_text(ACTIONS.replace("ENDPOINT", robot.endpoint))
        done = run_tests(folder)
        messages = {name: result.message for name, result in done.results.items()}
        assert [request["do"] for _, request in robot.hears] == ["light"]
    assert messages["a.lights"] == ""
    assert "light is of the risk 'state', this test of 'record'" in messages["a.only_reads"]
    assert "drive is of the risk 'moves', this test of 'state'" in messages["a.moves"]
    assert "3 is above the largest value, 2 m" in messages["a.too_far"]
    assert "did you mean 'light'?" in messages["a.typo"]
    assert done.outcomes == {name: "failed" if m else "passed" for name, m in messages.items()}


def test_a_run_grants_no_more_than_its_own_risk(tmp_path: Path) -> None:
    with zmq_robot() as robot:
        folder = write_tests(tmp_path, a=DRIVES.format(limit=30))
        (folder / "actions").mkdir()
        (folder / "actions" / "a.yaml").write_text(ACTIONS.replace("ENDPOINT", robot.endpoint))
        done = run_tests(folder, most_risk="state", names=("a.drives",))
        assert not robot.hears
        assert list(done.results) == ["a.drives"]
        assert "was only granted 'state'" in done.results["a.drives"].message
        assert run_tests(folder, simulated=True).outcomes["a.drives"] == "passed"
        assert not robot.hears


def test_a_motion_is_stopped_when_its_test_takes_too_long(tmp_path: Path) -> None:
    with zmq_robot() as robot:
        folder = write_tests(tmp_path, a=DRIVES.format(limit=5))
        (folder / "actions").mkdir()
        (folder / "actions" / "a.yaml").write_text(ACTIONS.replace("ENDPOINT", robot.endpoint))
        done = run_tests(folder)
        assert robot.heard("linear") and robot.heard("stop") and not robot.moving
    assert done.outcomes == {"a.drives": "timeout", "a.next": "passed"}


@pytest.mark.parametrize("who", ["test", "supervisor"])
def test_a_motion_is_stopped_when_its_process_is_killed(tmp_path: Path, who: str) -> None:
    pid = tmp_path / "pid"
    with zmq_robot() as robot:
        folder = write_tests(tmp_path, a=DRIVES.format(limit=60))
        with (folder / "tests" / "test_a.py").open("a") as file:
            number = "os.getpid()" if who == "test" else "os.getppid()"
            file.write(f"open({str(pid)!r}, 'w').write(str({number}))\n")
        (folder / "actions").mkdir()
        (folder / "actions" / "a.yaml").write_text(ACTIONS.replace("ENDPOINT", robot.endpoint))
        run = UnitTestRun(RunTask(str(folder)))
        robot.wait_until("linear")
        killed_s = boot_s()
        os.kill(int(pid.read_text()), signal.SIGKILL)
        assert robot.wait_until("stop")[0] > killed_s
        run.close()


def test_what_an_action_has_done_is_unknown_so_nothing_more_runs(tmp_path: Path) -> None:
    with zmq_robot() as robot:
        robot.answers["stop"] = b'{"ok": false}'
        folder = write_tests(tmp_path, a=DRIVES.format(limit=5))
        text = ACTIONS.replace("ENDPOINT", robot.endpoint).replace(
            "safe_stop: {do: stop}", "safe_stop: {do: stop}\n  expect: {ok: true}"
        )
        (folder / "actions").mkdir()
        (folder / "actions" / "a.yaml").write_text(text)
        done = run_tests(folder)
    assert done.outcomes == {"a.drives": "timeout", "a.next": "skipped"}
    assert "unknown" in done.results["a.next"].message
