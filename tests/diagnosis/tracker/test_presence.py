from __future__ import annotations

import json

from amberbox.diagnosis.symptom_presence import SymptomPresence, SymptomPresences
from tests.diagnosis.tracker.robot import TEXT, At, gone, knowledge, seconds

NAME = "laser/scan/clear"


def presence(*happens: At) -> SymptomPresence:
    """Return a symptom (2 s of hold, within 10 s) to which this happened."""
    presences = SymptomPresences(knowledge().fmea)
    for at in happens:
        presences.take(at.symptom(), seconds(at.at_s))
    return presences[NAME]


def test_counts_while_present_and_for_its_hold_after() -> None:
    one = presence(At(1, NAME), gone(5, NAME))
    assert not one.is_there
    assert [one.counts_present(seconds(at)) for at in (5, 6.9, 7, 8)] == [True, True, False, False]
    assert one.may_be_absent_ns == seconds(17)


def test_keeps_its_onset_when_it_comes_back_in_time() -> None:
    assert presence(At(1, NAME), gone(5, NAME), At(6.9, NAME)).onset_ns == seconds(1)
    assert presence(At(1, NAME), gone(5, NAME), At(7, NAME)).onset_ns == seconds(7)
    assert presence(At(3, NAME, onset_s=1.5)).onset_ns == seconds(1.5)


def test_what_becomes_unknown_goes_on_to_count_for_ten_minutes_and_its_hold() -> None:
    one = presence(At(1, NAME), At(5, NAME, "unknown"))
    assert one.counts_present(seconds(606.9)) and not one.counts_present(seconds(607))
    assert not one.is_absent


def test_what_was_unknown_begins_to_be_forgotten_when_it_is_seen_absent() -> None:
    one = presence(At(1, NAME), At(5, NAME, "unknown"), gone(300, NAME))
    assert one.counts_present(seconds(301.9)) and not one.counts_present(seconds(302))
    assert one.may_be_absent_ns == seconds(312)


def test_what_nobody_can_look_at_does_not_fade() -> None:
    one = presence(At(1, NAME), gone(5, NAME), At(6.5, NAME, "unknown"), gone(100, NAME))
    assert one.counts_present(seconds(100.4)) and not one.counts_present(seconds(100.5))


def test_what_had_faded_is_not_remembered_when_it_becomes_unknown() -> None:
    one = presence(At(1, NAME), gone(5, NAME), At(8, NAME, "unknown"))
    assert not one.counts_present(seconds(8))


def test_it_is_remembered_no_longer_than_the_file_says() -> None:
    presences = SymptomPresences(knowledge(f"remember_s: 3\n{TEXT}").fmea)
    for at in (At(1, NAME), At(5, NAME, "unknown"), At(7, NAME, "absent", ("bus",))):
        presences.take(at.symptom(), seconds(at.at_s))
    one = presences[NAME]
    assert one.counts_present(seconds(9.9)) and not one.counts_present(seconds(10))


def test_what_comes_while_it_is_blocked_is_no_evidence() -> None:
    one = presence(At(1, NAME, blocked_by=("bus",)))
    assert not one.counts_present(seconds(60)) and not one.is_absent
    one.take(At(61, NAME).symptom(), seconds(61))
    assert one.counts_present(seconds(61)), "nothing blocks it any more"


def test_what_comes_while_it_is_blocked_counts_if_what_blocks_may_show_it() -> None:
    one = presence(At(1, NAME, blocked_by=("laser/heartbeat",)))
    assert one.counts_present(seconds(60)) and one.shown("present").blocked_by == ()


def test_what_was_there_before_it_was_blocked_goes_on_to_count() -> None:
    one = presence(At(1, NAME), At(5, NAME, blocked_by=("bus",)))
    assert one.counts_present(seconds(60))
    assert one.onset_ns == seconds(1)


def test_what_is_blocked_is_never_seen_absent() -> None:
    one = presence(At(1, NAME), At(5, NAME, "absent", ("bus",)))
    assert one.counts_present(seconds(606.9)) and not one.counts_present(seconds(607))
    assert not one.is_absent


def test_is_shown_as_what_it_counts_as() -> None:
    one = presence(At(1, NAME), gone(5, NAME))
    held = one.shown("present")
    assert (held.state, held.onset_ns, held.confirmed_ns) == ("present", seconds(1), seconds(1))
    assert one.shown("").state == "unknown" and one.shown("absent") == one.latest
    blocked = presence(At(1, NAME, blocked_by=("bus",)))
    assert blocked.shown("") == blocked.latest and blocked.latest.blocked_by == ("bus",)


def test_is_kept_as_json() -> None:
    presences = SymptomPresences(knowledge().fmea)
    for at in (
        At(1, NAME),
        gone(5, NAME),
        At(6, "motor.hot"),
        At(6.5, NAME, "unknown"),
        At(7, "other/one/here", "unknown"),
        At(8, "base/drive/follows", blocked_by=("bus",)),
    ):
        presences.take(at.symptom(), seconds(at.at_s))
    other = SymptomPresences(knowledge().fmea)
    other.resume(json.loads(json.dumps(presences.snapshot())))
    assert dict(other) == dict(presences)
    assert other.snapshot() == presences.snapshot()
