"""A robot's join line is parsed without loss, or refused without repeating the key."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from amberbox.core.errors import UsageError
from amberbox.link.join_line import JoinLine, join_line, read_join_line

KEY = "abr_0123456789ab_" + "K" * 20 + "7_-" + "x" * 20
CA = "3f" * 32
LINE = f"amberbox+https://ropod_001:{KEY}@fleet.example:8443/?ca=sha256:{CA}"


def test_the_line() -> None:
    made = join_line("https://fleet.example:8443", "ropod_001", KEY, CA)
    assert str(made) == LINE
    assert read_join_line(f"  {LINE}\n") == made
    assert KEY not in repr(made)


def test_a_fingerprint_as_tools_print_it() -> None:
    printed = ":".join(["3F"] * 32)
    assert join_line("https://fleet.example", "r1", KEY, printed).ca == CA


IDS = st.from_regex(r"[a-z0-9_.-]{1,64}", fullmatch=True).filter(lambda id_: id_.strip(".") != "")
HOSTS = st.sampled_from(["fleet.example", "10.0.0.7:8443", "[2001:db8::7]:8443", "localhost"])
PATHS = st.sampled_from(["", "/amberbox", "/a/b"])


@given(IDS, HOSTS, PATHS, st.sampled_from(["", CA]))
def test_every_line_comes_back(robot: str, host: str, path: str, ca: str) -> None:
    made = JoinLine(f"https://{host}{path}", robot, KEY, ca)
    assert read_join_line(str(made)) == made


@pytest.mark.parametrize(
    "line",
    [
        "",
        "https://ropod_001",
        LINE.replace("amberbox+https", "https"),
        LINE.replace("amberbox+https", "amberbox+http"),
        LINE[:-1],
        LINE[:60],
        LINE.replace("sha256", "sha1"),
        LINE.replace("?ca=", "?cert="),
        LINE + "&ca=sha256:" + "00" * 32,
        LINE + "#x",
        LINE.replace("ropod_001", "Ropod"),
        LINE.replace("ropod_001", ".."),
        LINE.replace(":8443", ":port"),
        LINE.replace(KEY, KEY[:-1]),
        LINE.replace("fleet.example", ""),
        LINE.replace("?ca", " ?ca"),
        LINE.replace("abr_", "abt_"),
    ],
)
def test_what_is_no_line_is_refused_without_its_key(line: str) -> None:
    with pytest.raises(UsageError, match="not a line that a server gave") as refused:
        read_join_line(line)
    assert KEY[20:-5] not in str(refused.value)
    assert refused.value.__cause__ is None


@pytest.mark.parametrize("url", ["http://127.0.0.1:8080", "http://localhost", "http://[::1]:80"])
def test_this_machine_needs_no_tls(url: str) -> None:
    assert join_line(url, "r1", KEY).url == url


def test_elsewhere_does(url: str = "http://10.0.0.7:8080") -> None:
    with pytest.raises(UsageError, match="without TLS"):
        join_line(url, "r1", KEY)
