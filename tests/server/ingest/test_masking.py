"""Masking finds the same secrets as the earlier patterns, in time linear in the length of the text.

The patterns below are simpler, and take quadratic time for texts that a hostile robot may send.
"""

from __future__ import annotations

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amberbox.agent.folder_upload import WORD, mask_by_form, mask_quoted, mask_text
from amberbox.core.redaction import MASK, SOUNDS_SECRET, redact, secrets_by_name
from amberbox.core.yaml_nodes import parse_yaml
from amberbox.server.ingest.worker import mask_lines
from tests.fuzzing import examples, fuzz

LINES = re.compile(
    rf"(?im)^(?P<key>[\s\-#\"'<]*[\w.\-]*{SOUNDS_SECRET}[\w.\-]*[\"']?\s*[:=>]\s*)"
    r"(?P<value>[^\s{\[|>&*].*)$"
)
USER = re.compile(r"([a-zA-Z][a-zA-Z0-9+.-]*://)[^/\s@'\"<>]+@")
QUERY = re.compile(rf"([?&]\w*(?:{SOUNDS_SECRET}|key|sig)\w*=)[^&\s#'\"<>]+", re.IGNORECASE)
SAID = re.compile(
    rf"(\b\w*{SOUNDS_SECRET}\w*[\"']?\s*(?:[:=]|\bis\b)\s*)(\"[^\"]*\"|'[^']*'|[^\s\"'<>,;]+)",
    re.IGNORECASE,
)
ELEMENT = re.compile(rf"(<\w*{SOUNDS_SECRET}\w*\b[^>]*>)[^<]+(</)", re.IGNORECASE)

PIECES = (
    "password", "secret", "token", "api", "key", "access", "private", "api_key", "api-key",
    "API key", "is", "x", "a1", "sig", " ", "\n", "\t", "-", "--", "#", "'", '"', "<", ">", "</",
    "=", ":", "=>", ".", "{", "[", "|", "&", "*", "?", "://", "http", "@", "***", "(masked)", "é",
    "\u212a", "\u017f", "+", "1", "/", ",", ";",
)  # fmt: skip
TEXTS = st.lists(st.sampled_from(PIECES), max_size=25).map("".join)


def lines_of_before(text: str) -> str:
    """Mask as the server did."""

    def hidden(found: re.Match[str]) -> str:
        is_masked = found["value"].strip("\"' ,;<").startswith((MASK, "(masked)"))
        return found[0] if is_masked else f"{found['key']}'{MASK}'"

    return LINES.sub(hidden, text)


@fuzz
@given(TEXTS)
@settings(max_examples=examples(400))
def test_the_server_masks_what_it_masked(text: str) -> None:
    assert mask_lines(text) == lines_of_before(text)


@fuzz
@given(TEXTS)
@settings(max_examples=examples(400))
def test_a_robot_masks_what_it_masked(text: str) -> None:
    before = ELEMENT.sub(rf"\1{WORD}\2", text)
    assert mask_text(text) == SAID.sub(lambda match: match[1] + mask_quoted(match[2]), before)
    assert mask_by_form(text) == USER.sub(rf"\1{MASK}@", QUERY.sub(rf"\1{WORD}", text))


@pytest.mark.parametrize(
    ("text", "masked"),
    [
        ("\n\n  password\n :\n\n  hunter2 x\nid: 1\n", "\n\n  password\n :\n\n  '***'\nid: 1\n"),
        ("my-api key.old = v", "my-api key.old = '***'"),
        ("--secret: v\n---\n", "--secret: '***'\n---\n"),
        ("token: '***'\n", "token: '***'\n"),
    ],
)
def test_keys_and_values_may_stand_apart(text: str, masked: str) -> None:
    assert mask_lines(text) == masked == lines_of_before(text)


def test_values_in_yaml_are_replaced_where_they_stand() -> None:
    text = "a: {token: x, secret: {b: c}}\nd: &e password\npassword: *e\nkeys: [1]\n"
    node = parse_yaml(text, "x.yaml", [])
    assert node is not None
    assert redact(text, secrets_by_name(node)) == text.replace("x", "'***'", 1).replace(
        "{b: c}", "'***'"
    ).replace("password", "'***'", 1).replace("&e '***'", "&e '***'")
