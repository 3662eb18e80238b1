"""Components of a model as a drawing."""

from __future__ import annotations

import pytest

from amberbox.server.drawing.parts import PartBox, parts_graph

HOSTILE = '"><script>alert(1)</script>'


def test_parts_and_their_connections() -> None:
    parts = [PartBox("main", "breaker", "error", "faulty"), PartBox("arm", "breaker"),
             PartBox("lonely", HOSTILE)]  # fmt: skip
    connections = [
        ["main.out", "arm.in", "base.in"], ["arm.more", "main.more"], ["arm.a", "arm.b"]
    ]  # fmt: skip
    drawn = parts_graph(parts, connections, label="power")
    edges = [one for one in drawn.all() if one.get("class") == "edge"]
    assert [(one.get("data-start"), one.get("data-end")) for one in edges] == [("main", "arm")]
    assert "main.out = arm.in; arm.more = main.more" in str(edges[0])
    nodes = {one.get("data-id"): one for one in drawn.all() if one.get("data-id")}
    assert list(nodes) == ["main", "arm", "lonely"]
    assert nodes["main"].get("class") == "node level-error"
    assert "icon" not in str(nodes["arm"])
    assert "<script" not in str(drawn)


@pytest.mark.parametrize("count", [0, 1, 80])
def test_any_number_is_drawn(count: int) -> None:
    parts = [PartBox(f"c{number}", "it", "ok", "fine") for number in range(count)]
    ring = [[f"c{n}.out", f"c{(n + 1) % count}.in"] for n in range(count)]
    drawn = parts_graph(parts, ring, label="ring")
    assert sum(one.get("class").startswith("node") for one in drawn.all()) == count
