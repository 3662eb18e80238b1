"""The description of a session's browser, in words."""

import pytest

from amberbox.server.web.account import device

CHROME = "Mozilla/5.0 (X11; Linux x86_64) AppleWebKit/537.36 (KHTML, like Gecko) Chrome/140.0 Safari/537.36"  # noqa: E501  # as browsers send it
PHONE = "Mozilla/5.0 (iPhone; CPU iPhone OS 18_0 like Mac OS X) AppleWebKit/605.1.15 (KHTML, like Gecko) Version/18.0 Mobile/15E148 Safari/604.1"  # noqa: E501  # as browsers send it


@pytest.mark.parametrize(
    ("agent", "words"),
    [
        (CHROME, "Chrome on Linux"),
        (CHROME.replace("X11; Linux x86_64", "Linux; Android 15"), "Chrome on Android"),
        (CHROME.replace("X11; Linux x86_64", "Windows NT 10.0") + " Edg/140.0", "Edge on Windows"),
        (PHONE, "Safari on iPhone"),
        ("Mozilla/5.0 (Macintosh; Intel Mac OS X 15) Gecko/1 Firefox/143.0", "Firefox on macOS"),
        ("python-requests/2.32", "python-requests"),
        ("<script>alert(1)</script>", "something unknown"),
        ("", "something unknown"),
    ],
)
def test_devices_in_words(agent: str, words: str) -> None:
    assert device(agent) == words
