"""One child: back-off, hanging, refusal and the end, on a clock that is moved by hand."""

from __future__ import annotations

import random
import signal

import pytest

from amberbox.agent.process import ChildProcess
from amberbox.agent.supervisor import ChildLifecycle, exit_in_words
from amberbox.core.pacing import Backoff
from amberbox.core.systemd import ALL_INPUTS_ENDED
from tests.agent.fake_process import FakeLauncher

CHILD = ChildProcess("watch", ["watch"], watchdog_s=10.0, start_s=30.0)


@pytest.fixture
def launcher() -> FakeLauncher:
    return FakeLauncher()


@pytest.fixture
def lifecycle(launcher: FakeLauncher) -> ChildLifecycle:
    made = ChildLifecycle(CHILD, launcher.launch, launcher.tell, Backoff(random.Random(1)))
    made.want(0.0)
    made.step(0.0)
    return made


def run_until(
    lifecycle: ChildLifecycle, launcher: FakeLauncher, now_s: float, most_s: float
) -> float:
    """Step every tenth of a second until another process is started; return when that was."""
    count, end_s = len(launcher.started), now_s + most_s
    while len(launcher.started) == count:
        now_s += 0.1
        assert now_s < end_s, "never started again"
        lifecycle.step(now_s)
    return now_s


def test_it_waits_longer_each_time_but_never_longer_than_half_a_minute(
    lifecycle: ChildLifecycle, launcher: FakeLauncher
) -> None:
    now_s, waits = 0.0, []
    for _ in range(12):
        launcher.last.status = 1
        began_s, now_s = now_s, run_until(lifecycle, launcher, now_s, 40.0)
        waits.append(now_s - began_s)
    for n, wait_s in enumerate(waits):
        whole_s = min(0.5 * 2**n, 30.0)
        assert max(0.5, whole_s / 2) <= wait_s <= whole_s + 0.3, waits
    assert len({round(wait_s, 1) for wait_s in waits[-5:]}) > 1, "no jitter"
    assert lifecycle.restarts == 12
    assert all(kind == "process_died" for kind, _ in launcher.told)


def test_a_minute_of_health_makes_it_quick_again(
    lifecycle: ChildLifecycle, launcher: FakeLauncher
) -> None:
    now_s = 0.0
    for _ in range(8):
        launcher.last.status = -11
        now_s = run_until(lifecycle, launcher, now_s, 40.0)
    launcher.last.tell(("READY", "1"))
    for _ in range(7):
        now_s += 9.0
        launcher.last.tell(("WATCHDOG", "1"))
        lifecycle.step(now_s)
    launcher.last.status = -11
    assert run_until(lifecycle, launcher, now_s, 40.0) - now_s < 0.8
    assert "was killed by SIGSEGV" in launcher.told[-1][1]


def test_one_without_a_sign_of_life_is_killed(
    lifecycle: ChildLifecycle, launcher: FakeLauncher
) -> None:
    launcher.last.tell(("READY", "1"), ("STATUS", "19 components"))
    lifecycle.step(1.0)
    assert lifecycle.is_up and lifecycle.status == "19 components"
    launcher.last.tell(("WATCHDOG", "1"))
    lifecycle.step(9.0)
    lifecycle.step(18.9)
    assert launcher.last.sent == []
    lifecycle.step(19.1)
    assert launcher.last.sent == [signal.SIGKILL]
    lifecycle.step(19.2)
    assert launcher.told == [("process_hung", launcher.told[0][1])]
    assert "gave no sign of life for 10 s and was killed" in launcher.told[0][1]
    run_until(lifecycle, launcher, 19.2, 1.0)


def test_one_that_is_not_ready_is_killed_unless_it_asks_for_time(
    lifecycle: ChildLifecycle, launcher: FakeLauncher
) -> None:
    lifecycle.step(29.0)
    launcher.last.tell(("EXTEND_TIMEOUT_USEC", "30000000"))
    lifecycle.step(29.5)
    lifecycle.step(59.0)
    assert launcher.last.sent == []
    lifecycle.step(60.0)
    assert launcher.last.sent == [signal.SIGKILL]
    lifecycle.step(60.1)
    assert (
        launcher.told[0][0] == "process_hung" and "is not ready after 60 s" in launcher.told[0][1]
    )


def test_a_wrong_configuration_is_said_once_and_tried_each_minute(
    lifecycle: ChildLifecycle, launcher: FakeLauncher
) -> None:
    for minute in range(3):
        launcher.last.words, launcher.last.status = "the robot has no such file", 2
        lifecycle.step(60.5 * minute + 0.1)
        assert lifecycle.state == "refused"
        lifecycle.step(60.5 * minute + 59.0)
        assert len(launcher.started) == minute + 1
        lifecycle.step(60.5 * (minute + 1))
        assert len(launcher.started) == minute + 2
    assert [kind for kind, _ in launcher.told] == ["process_refused"]
    assert "the robot has no such file" in launcher.told[0][1]
    assert lifecycle.restarts == 0


def test_what_was_refused_is_tried_when_something_has_changed(
    lifecycle: ChildLifecycle, launcher: FakeLauncher
) -> None:
    launcher.last.status = 2
    lifecycle.step(0.1)
    lifecycle.retry(5.0)
    lifecycle.step(5.0)
    assert len(launcher.started) == 2
    launcher.last.status = 2
    lifecycle.step(6.0)
    assert len(launcher.told) == 2, "after a change it is said again"


def test_the_end_is_asked_for_then_forced(
    lifecycle: ChildLifecycle, launcher: FakeLauncher
) -> None:
    launcher.last.obeys = False
    lifecycle.stop(10.0, 3.0)
    lifecycle.stop(11.0, 3.0)
    assert launcher.last.sent == [signal.SIGTERM]
    launcher.last.tell(("WATCHDOG", "1"))  # a sign of life is no reason to wait
    lifecycle.step(12.9)
    assert launcher.last.sent == [signal.SIGTERM]
    lifecycle.step(13.0)
    lifecycle.step(13.1)
    assert launcher.last.sent[1:] == [signal.SIGKILL]
    assert lifecycle.state == "off" and launcher.last.is_closed
    assert launcher.told == [("process_killed", "watch did not end in time and was killed")]
    lifecycle.step(500.0)
    assert len(launcher.started) == 1


def test_it_begins_anew_without_waiting_when_asked_to(
    lifecycle: ChildLifecycle, launcher: FakeLauncher
) -> None:
    lifecycle.stop(10.0, 3.0, restart=True)
    lifecycle.step(10.1)
    lifecycle.step(10.2)
    assert len(launcher.started) == 2 and launcher.told == [] and lifecycle.restarts == 0


def test_one_that_waits_is_off_at_once(lifecycle: ChildLifecycle, launcher: FakeLauncher) -> None:
    launcher.last.status = 1
    lifecycle.step(0.1)
    lifecycle.stop(0.2, 3.0)
    assert lifecycle.state == "off"
    lifecycle.step(100.0)
    assert len(launcher.started) == 1


def test_one_that_has_nothing_left_to_do_stays_ended(
    lifecycle: ChildLifecycle, launcher: FakeLauncher
) -> None:
    launcher.last.tell(("READY", "1"), ("STOPPING", "1"), ("STATUS", ALL_INPUTS_ENDED))
    launcher.last.status = 0
    lifecycle.step(1.0)
    assert lifecycle.state == "spent"
    lifecycle.step(100.0)
    assert len(launcher.started) == 1 and launcher.told == []


def test_one_that_ends_in_order_by_itself_begins_again(
    lifecycle: ChildLifecycle, launcher: FakeLauncher
) -> None:
    launcher.last.tell(("READY", "1"), ("STOPPING", "1"), ("STATUS", "writing the rest"))
    launcher.last.status = 0
    lifecycle.step(1.0)
    run_until(lifecycle, launcher, 1.0, 1.0)
    assert "watch ended by itself" in launcher.told[0][1]


def test_what_cannot_be_started_is_tried_again(launcher: FakeLauncher) -> None:
    launcher.trouble = OSError(12, "Cannot allocate memory")
    lifecycle = ChildLifecycle(CHILD, launcher.launch, launcher.tell)
    lifecycle.want(0.0)
    lifecycle.step(0.0)
    assert "cannot be started: Cannot allocate memory" in launcher.told[0][1]
    launcher.trouble = None
    run_until(lifecycle, launcher, 0.0, 1.0)


@pytest.mark.parametrize(
    ("status", "words"),
    [(0, "ended by itself"), (3, "ended with status 3"), (-9, "was killed by SIGKILL"),
     (-99, "was killed by signal 99")],
)  # fmt: skip
def test_an_end_in_words(status: int, words: str) -> None:
    assert exit_in_words(status) == words
