"""The explanation of a diagnosis in words, for each of the alarms that it concerns."""

from __future__ import annotations

from amberbox.core.api import LeadingCause, Words
from amberbox.server.alarms.alarm import decode_words, encode_words

NAMES = {"laser#silent": "front laser is silent", "motor#weak": "motor is weak"}
BOTH = LeadingCause("both are broken", faults=["laser#silent", "motor#weak"])


def texts(words: Words) -> list[str]:
    return [cause.text for cause in words.causes]


def test_an_alarm_has_the_words_of_its_own_cause() -> None:
    words = Words([BOTH], 0.9, NAMES)
    assert texts(words.about("motor#weak (very likely)")) == ["motor is weak"]
    assert texts(words.about("laser#silent + motor#weak (likely)")) == ["both are broken"]


def test_words_stay_whole_where_the_cause_names_none_of_them() -> None:
    words = Words([BOTH], 0.9, NAMES)
    assert words.about("") == words.about("wheel#slip (likely)") == words
    old = decode_words(
        '{"causes":[{"text":"motor is weak","kind":"fault"}],"probability":0.9,"names":{}}'
    )
    assert old is not None and old.about("motor#weak (likely)") == old


def test_what_differs_only_by_another_cause_is_said_once() -> None:
    other = LeadingCause("others are broken", faults=["laser#silent", "wheel#slip"])
    words = Words([BOTH, other], 0.9, NAMES)
    assert texts(words.about("laser#silent (likely)")) == ["front laser is silent"]
    assert decode_words(encode_words(words)) == words
