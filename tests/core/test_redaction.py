"""Secrets leave files and listings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import pytest
import yaml

from amberbox.core.options import option
from amberbox.core.redaction import masked_values, redact, secrets, secrets_by_name, sounds_secret
from amberbox.core.yaml_nodes import Node, parse_yaml


@dataclass(frozen=True)
class Login:
    """Has a secret with another spelling."""

    user: str = option("")
    password: str = option("", secret=True, aliases=("pass",))


@dataclass(frozen=True)
class Box:
    """Has secrets at every place that can hold one."""

    token: str = option("", secret=True)
    login: Login | None = option(None)
    topics: Sequence[Login] = option(())
    by_name: Mapping[str, Login] = option({})
    keys: Sequence[str] = option((), secret=True)


TEXT = """\
token: "swordfish"   # keep this comment
login: {user: bob, pass: swordfish}
topics:
  - topic: {password: 'sword fish', user: eve}
  - password: >
      swordfish
    user: ada
by_name:
  x: {password: &p swordfish}
  y: {password: *p}
keys: [swordfish, a]
"""


def tree(text: str) -> Node:
    root = parse_yaml(text, "f", [])
    assert root is not None
    return root


def test_secrets_are_cut_out_of_the_text() -> None:
    redacted = redact(TEXT, secrets(Box, tree(TEXT)))
    assert "swordfish" not in redacted
    assert "sword fish" not in redacted
    assert "# keep this comment" in redacted
    plain = yaml.safe_load(redacted)
    assert plain["login"] == {"user": "bob", "pass": "***"}
    assert plain["topics"][1] == {"password": "***", "user": "ada"}
    assert plain["keys"] == "***"


def test_unknown_blocks_lose_what_sounds_secret() -> None:
    text = "host: a\nmqtt_password: x1\nnested: [{api_key: x2, Token: x3, tokens: {a: x4}}]\n"
    redacted = redact(text, secrets_by_name(tree(text)))
    assert yaml.safe_load(redacted)["host"] == "a"
    assert not any(secret in redacted for secret in ("x1", "x2", "x3", "x4"))


@pytest.mark.parametrize(
    "key", ["mqtt_password", "PASSWD", "apiKey", "API key", "access-key", "tokens", "credentials"]
)
def test_what_sounds_secret(key: str) -> None:
    assert sounds_secret(key)


@pytest.mark.parametrize("key", ["host", "keys", "passed", "public_key", "keyboard", ""])
def test_what_does_not(key: str) -> None:
    assert not sounds_secret(key)


def test_listings_mask_secrets() -> None:
    box = Box("swordfish", Login("bob", "swordfish"), (Login("eve"),), {"x": Login("", "s")})
    assert masked_values(box) == {
        "token": "***",
        "login": {"user": "bob", "password": "***"},
        "topics": [{"user": "eve", "password": ""}],
        "by_name": {"x": {"user": "", "password": "***"}},
        "keys": [],
    }
