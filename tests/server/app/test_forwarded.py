"""The address of a request: headers of trusted proxies count, others do not."""

from __future__ import annotations

import ipaddress

import pytest

from amberbox.server.config import client_address

PROXIES = (ipaddress.ip_network("10.0.0.5"), ipaddress.ip_network("192.0.2.0/24"))


@pytest.mark.parametrize(
    ("peer", "forwarded", "found"),
    [
        ("203.0.113.9", ["1.2.3.4"], "203.0.113.9"),  # forged: it did not come by a proxy
        ("10.0.0.5", ["203.0.113.9"], "203.0.113.9"),
        ("10.0.0.5", ["1.2.3.4, 203.0.113.9"], "203.0.113.9"),  # the left one may be forged
        ("10.0.0.5", ["1.2.3.4", "203.0.113.9, 192.0.2.7"], "203.0.113.9"),  # two proxies
        ("10.0.0.5", [], "10.0.0.5"),
        ("10.0.0.5", ["nonsense"], "10.0.0.5"),
        ("10.0.0.5", ["1.2.3.4, <script>"], "10.0.0.5"),
        ("10.0.0.5", ["192.0.2.7"], "192.0.2.7"),
        ("10.0.0.5", ["203.0.113.9:51234"], "203.0.113.9"),
        ("10.0.0.5", ['"[2001:db8::1]:443"'], "2001:db8::1"),
        ("::ffff:10.0.0.5", ["2001:db8::1"], "2001:db8::1"),
        ("testclient", ["1.2.3.4"], "testclient"),
    ],
)
def test_the_first_from_the_right_that_is_no_proxy_has_asked(
    peer: str, forwarded: list[str], found: str
) -> None:
    assert client_address(peer, forwarded, PROXIES) == found


def test_without_proxies_nobody_is_believed() -> None:
    assert client_address("127.0.0.1", ["203.0.113.9"], ()) == "127.0.0.1"
