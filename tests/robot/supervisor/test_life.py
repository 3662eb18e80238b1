"""One child: back-off, hanging, refusal and the end, on a clock that is moved by hand."""

from __future__ import annotations

import random
import signal

import pytest

from amberbox.blackbox.service import SPENT
from amberbox.link.backoff import Backoff
from amberbox.robot.supervisor.child import Child
from amberbox.robot.supervisor.life import Life, in_words
from tests.robot.supervisor.puppet import Theatre

CHILD = Child("watch", ["watch"], watchdog_s=10.0, start_s=30.0)


@pytest.fixture
def theatre() -> Theatre:
    return Theatre()


@pytest.fixture
def life(theatre: Theatre) -> Life:
    made = Life(CHILD, theatre.launch, theatre.tell, Backoff(random.Random(1)))
    made.want(0.0)
    made.step(0.0)
    return made


def run_until(life: Life, theatre: Theatre, now_s: float, most_s: float) -> float:
    """Step every tenth of a second until another process is started; return when that was."""
    count, end_s = len(theatre.puppets), now_s + most_s
    while len(theatre.puppets) == count:
        now_s += 0.1
        assert now_s < end_s, "never started again"
        life.step(now_s)
    return now_s


def test_it_waits_longer_each_time_but_never_longer_than_half_a_minute(
    life: Life, theatre: Theatre
) -> None:
    now_s, waits = 0.0, []
    for _ in range(12):
        theatre.last.status = 1
        began_s, now_s = now_s, run_until(life, theatre, now_s, 40.0)
        waits.append(now_s - began_s)
    for n, wait_s in enumerate(waits):
        whole_s = min(0.5 * 2**n, 30.0)
        assert max(0.5, whole_s / 2) <= wait_s <= whole_s + 0.3, waits
    assert len({round(wait_s, 1) for wait_s in waits[-5:]}) > 1, "no jitter"
    assert life.restarts == 12
    assert all(kind == "process_died" for kind, _ in theatre.told)


def test_a_minute_of_health_makes_it_quick_again(life: Life, theatre: Theatre) -> None:
    now_s = 0.0
    for _ in range(8):
        theatre.last.status = -11
        now_s = run_until(life, theatre, now_s, 40.0)
    theatre.last.tell(("READY", "1"))
    for _ in range(7):
        now_s += 9.0
        theatre.last.tell(("WATCHDOG", "1"))
        life.step(now_s)
    theatre.last.status = -11
    assert run_until(life, theatre, now_s, 40.0) - now_s < 0.8
    assert "was killed by SIGSEGV" in theatre.told[-1][1]


def test_one_without_a_sign_of_life_is_killed(life: Life, theatre: Theatre) -> None:
    theatre.last.tell(("READY", "1"), ("STATUS", "19 components"))
    life.step(1.0)
    assert life.is_up and life.status == "19 components"
    theatre.last.tell(("WATCHDOG", "1"))
    life.step(9.0)
    life.step(18.9)
    assert theatre.last.sent == []
    life.step(19.1)
    assert theatre.last.sent == [signal.SIGKILL]
    life.step(19.2)
    assert theatre.told == [("process_hung", theatre.told[0][1])]
    assert "gave no sign of life for 10 s and was killed" in theatre.told[0][1]
    run_until(life, theatre, 19.2, 1.0)


def test_one_that_is_not_ready_is_killed_unless_it_asks_for_time(
    life: Life, theatre: Theatre
) -> None:
    life.step(29.0)
    theatre.last.tell(("EXTEND_TIMEOUT_USEC", "30000000"))
    life.step(29.5)
    life.step(59.0)
    assert theatre.last.sent == []
    life.step(60.0)
    assert theatre.last.sent == [signal.SIGKILL]
    life.step(60.1)
    assert theatre.told[0][0] == "process_hung" and "is not ready after 60 s" in theatre.told[0][1]


def test_a_wrong_configuration_is_said_once_and_tried_each_minute(
    life: Life, theatre: Theatre
) -> None:
    for minute in range(3):
        theatre.last.words, theatre.last.status = "the robot has no such file", 2
        life.step(60.5 * minute + 0.1)
        assert life.state == "refused"
        life.step(60.5 * minute + 59.0)
        assert len(theatre.puppets) == minute + 1
        life.step(60.5 * (minute + 1))
        assert len(theatre.puppets) == minute + 2
    assert [kind for kind, _ in theatre.told] == ["process_refused"]
    assert "the robot has no such file" in theatre.told[0][1]
    assert life.restarts == 0


def test_what_was_refused_is_tried_when_something_has_changed(life: Life, theatre: Theatre) -> None:
    theatre.last.status = 2
    life.step(0.1)
    life.retry(5.0)
    life.step(5.0)
    assert len(theatre.puppets) == 2
    theatre.last.status = 2
    life.step(6.0)
    assert len(theatre.told) == 2, "after a change it is said again"


def test_the_end_is_asked_for_then_forced(life: Life, theatre: Theatre) -> None:
    theatre.last.obeys = False
    life.stop(10.0, 3.0)
    life.stop(11.0, 3.0)
    assert theatre.last.sent == [signal.SIGTERM]
    theatre.last.tell(("WATCHDOG", "1"))  # a sign of life is no reason to wait
    life.step(12.9)
    assert theatre.last.sent == [signal.SIGTERM]
    life.step(13.0)
    life.step(13.1)
    assert theatre.last.sent[1:] == [signal.SIGKILL]
    assert life.state == "off" and theatre.last.is_closed
    assert theatre.told == [("process_killed", "watch did not end in time and was killed")]
    life.step(500.0)
    assert len(theatre.puppets) == 1


def test_it_begins_anew_without_waiting_when_asked_to(life: Life, theatre: Theatre) -> None:
    life.stop(10.0, 3.0, again=True)
    life.step(10.1)
    life.step(10.2)
    assert len(theatre.puppets) == 2 and theatre.told == [] and life.restarts == 0


def test_one_that_waits_is_off_at_once(life: Life, theatre: Theatre) -> None:
    theatre.last.status = 1
    life.step(0.1)
    life.stop(0.2, 3.0)
    assert life.state == "off"
    life.step(100.0)
    assert len(theatre.puppets) == 1


def test_one_that_has_nothing_left_to_do_stays_ended(life: Life, theatre: Theatre) -> None:
    theatre.last.tell(("READY", "1"), ("STOPPING", "1"), ("STATUS", SPENT))
    theatre.last.status = 0
    life.step(1.0)
    assert life.state == "spent"
    life.step(100.0)
    assert len(theatre.puppets) == 1 and theatre.told == []


def test_one_that_ends_in_order_by_itself_begins_again(life: Life, theatre: Theatre) -> None:
    theatre.last.tell(("READY", "1"), ("STOPPING", "1"), ("STATUS", "writing the rest"))
    theatre.last.status = 0
    life.step(1.0)
    run_until(life, theatre, 1.0, 1.0)
    assert "watch ended by itself" in theatre.told[0][1]


def test_what_cannot_be_started_is_tried_again(theatre: Theatre) -> None:
    theatre.trouble = OSError(12, "Cannot allocate memory")
    life = Life(CHILD, theatre.launch, theatre.tell)
    life.want(0.0)
    life.step(0.0)
    assert "cannot be started: Cannot allocate memory" in theatre.told[0][1]
    theatre.trouble = None
    run_until(life, theatre, 0.0, 1.0)


@pytest.mark.parametrize(
    ("status", "words"),
    [(0, "ended by itself"), (3, "ended with status 3"), (-9, "was killed by SIGKILL"),
     (-99, "was killed by signal 99")],
)  # fmt: skip
def test_an_end_in_words(status: int, words: str) -> None:
    assert in_words(status) == words
