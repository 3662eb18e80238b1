"""Adding the server to robot.yaml changes nothing else in it."""

from __future__ import annotations

import pytest

from amberbox.agent.join import with_server
from amberbox.core.errors import Problem, UsageError
from amberbox.core.yaml_nodes import parse_yaml

VALUES = {"url": "https://fleet.example:8443", "ca": "sha256:" + "ab" * 32}
BEFORE = "# who it is\nid: r1   # name\n\nstore: {quota: 5 GB}\n"


def server(text: str) -> object:
    problems: list[Problem] = []
    root = parse_yaml(text, "robot.yaml", problems)
    assert root is not None and root.mapping is not None and not problems
    return root.mapping["server"].plain()


@pytest.mark.parametrize(
    ("text", "rest"),
    [
        (BEFORE, {}),
        ("", {}),
        ("id: r1", {}),
        (BEFORE + "server:\n", {}),
        (BEFORE + "server:\n  # ours\n  url: http://x  # it\n  copy: always\n", {"copy": "always"}),
        (BEFORE + "server:\n    copy: docked\n    url: 'x'\nid2: 1\n", {"copy": "docked"}),
        (BEFORE + "server: {url: x, token: abc, rate: 5}\n", {"rate": 5}),
        (BEFORE + "server: {token: abc, url: x}\n", {}),
        ("server:\n  url: x\n  token: abc # gone\n  live: off\nid: r1\n", {"live": "off"}),
    ],
)  # fmt: skip
def test_what_is_written_is_read_and_the_rest_stays(text: str, rest: dict[str, object]) -> None:
    done = with_server(text, VALUES, ("token",))
    assert server(done) == {**VALUES, **rest}
    for line in text.splitlines():
        if "#" in line and "token" not in line and "url" not in line:
            assert line in done
    assert with_server(done, VALUES, ("token",)) == done


def test_what_cannot_be_changed_safely_is_left_to_people() -> None:
    with pytest.raises(UsageError) as error:
        with_server("base: &base {url: x}\nserver: *base\nbad: [\n", VALUES)
    assert "by hand" in error.value.hint
