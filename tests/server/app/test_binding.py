"""Where the server listens: plain HTTP never leaves the machine."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.core.errors import UsageError
from amberbox.server import certificates
from amberbox.server.config import ListenOptions, resolve_settings

NOW_NS = 1_800_000_000 * 10**9


def test_without_a_word_it_is_for_this_machine(tmp_path: Path) -> None:
    found = resolve_settings(tmp_path, ListenOptions())
    assert (found.public_url, found.is_secure) == ("http://127.0.0.1:8443", False)


@pytest.mark.parametrize(
    ("wanted", "hint"),
    [
        (ListenOptions("0.0.0.0"), "serve cert"),
        (ListenOptions("::"), "serve cert"),
        (ListenOptions("192.0.2.1"), "serve cert"),
        (ListenOptions(public_url="http://fleet.example"), "--behind-proxy"),
        (ListenOptions("0.0.0.0", proxies=("10.0.0.5",)), "--public-url"),
        (ListenOptions("0.0.0.0", public_url="http://f.example", proxies=("10.0.0.5",)), "https"),
        (ListenOptions(public_url="https://f.example", proxies=("0.0.0.0/0",)), "own address"),
        (ListenOptions(public_url="https://f.example", proxies=("proxy",)), "such as"),
        (ListenOptions(public_url="ftp://f.example"), "such as"),
        (ListenOptions(public_url="http://a:b@localhost"), "such as"),
        (ListenOptions(port=70_000), "1 to 65535"),
    ],
)
def test_what_is_not_safe_is_refused(tmp_path: Path, wanted: ListenOptions, hint: str) -> None:
    with pytest.raises(UsageError) as refused:
        resolve_settings(tmp_path, wanted)
    assert hint in (refused.value.hint or "")


def test_behind_a_proxy_it_may_listen_anywhere(tmp_path: Path) -> None:
    wanted = ListenOptions("0.0.0.0", 80, "https://Fleet.example/", ("10.0.0.5", "10.1.0.0/16"))
    found = resolve_settings(tmp_path, wanted)
    assert (found.public_url, found.is_secure) == ("https://fleet.example", True)
    assert [str(one) for one in found.proxies] == ["10.0.0.5/32", "10.1.0.0/16"]


def test_with_a_certificate_it_speaks_tls_under_its_names(tmp_path: Path) -> None:
    certificates.make(tmp_path, ["fleet.example", "192.0.2.1"], NOW_NS)
    found = resolve_settings(tmp_path, ListenOptions("0.0.0.0"))
    assert found.public_url == "https://fleet.example:8443"
    assert found.names == ("fleet.example", "192.0.2.1")
    assert found.certificate is not None and found.is_secure
    for url in ("https://other.example", "http://fleet.example"):
        with pytest.raises(UsageError):
            resolve_settings(tmp_path, ListenOptions("0.0.0.0", public_url=url))
