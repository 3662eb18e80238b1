"""The pages of models: what they show, what they escape, and what is wrong."""

from __future__ import annotations

import html
import re
from collections.abc import Iterator
from typing import Any

import pytest
from starlette.testclient import TestClient

from amberbox.server.services import knowledge
from tests.browser import hostile
from tests.cli.test_consistency import POWER
from tests.cli.test_structure import WHEEL
from tests.server.house import House, house
from tests.server.knowledge import robot as sim

BASE = "/robots/ropod_001/models"
BROKEN = WHEEL.replace("[torque, current]", "[torque, '<b>curent']")


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give workers time: a first question on a busy machine is no test of their limits."""
    monkeypatch.setattr(knowledge, "LIMIT_S", 120.0)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("house"), shared=True) as found:
        more = {"wheel": WHEEL, "broken": BROKEN, "breakers": POWER}
        files = {f"models/{name}.yaml": text.encode() for name, text in more.items()}
        sim.hand_in(found, more={**hostile.model_files(), **files})
        sim.state(found)
        yield found


@pytest.fixture
def viewer(home: House) -> TestClient:
    return home.client("viewer")


def page(client: TestClient, path: str, **query: Any) -> str:
    answer = client.get(f"{BASE}/{path}", params=query)
    assert answer.status_code == 200, answer.text
    return str(answer.text)


def words(text: str) -> str:
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", text)).split())


def test_models_are_beside_the_fault_tree(viewer: TestClient) -> None:
    found = viewer.get("/robots/ropod_001/diagnosis/models").text
    assert f'<a href="{BASE}/wheel">' in found
    assert "models/broken.yaml:5: equations.motor" in words(found)
    assert "<b>curent" not in found


def test_the_matrix(viewer: TestClient) -> None:
    found = page(viewer, "wheel")
    assert "6 of 6 equations, 4 unknowns" in words(found)
    (turning,) = re.findall(r'<tr><th scope="row">turning</th>.*?</tr>', found)
    assert sorted(re.findall(r'class="over on">(.)</td>', turning)) == ["D", "I"]
    assert "1 of 6 equations" in words(page(viewer, "wheel", q="ENC sp"))
    assert page(viewer, "large").count("<tr>") == 95


def test_faults_and_sets(viewer: TestClient) -> None:
    found = words(page(viewer, "wheel", show="faults"))
    assert "4 of 4 faults can be detected; redundancy 2" in found
    assert "weak yes drags" in found
    assert "ammeter, encoder, winding" in page(viewer, "wheel", show="mso")
    assert "<li>torque</li>" in page(viewer, "wheel", show="sensor_sets", fallible="1")


def test_what_agrees_with_observations(viewer: TestClient) -> None:
    found = page(viewer, "breakers")
    assert "b1=tripped" in found and "b1, b2" in found
    assert found.count('class="node level-warn"') == 2
    more = page(viewer, "breakers", observe=["b1.out=on"])
    assert 'class="node level-error" data-id="b2"' in more
    assert 'value="b1.out=on"' in more
    wrong = page(viewer, "breakers", observe=["b1.ou=on"])
    assert "there is no port 'b1.ou'; did you mean 'b1.out'?" in words(wrong)
    assert "b1=tripped" in wrong and 'value="b1.ou=on"' in wrong


def test_what_is_wrong_is_said(viewer: TestClient) -> None:
    assert "This model cannot be used" in page(viewer, "broken")
    assert viewer.get(f"{BASE}/nothing").status_code == 404
    assert viewer.get("/robots/ropod_002/models/wheel").status_code in (400, 404)


@pytest.mark.parametrize("show", ["matrix", "faults", "mso", "mtes", "sensor_sets"])
def test_hostile_names_are_escaped(viewer: TestClient, show: str) -> None:
    for found in (page(viewer, "odd", show=show, q=""), page(viewer, "power", q=hostile.MARKUP)):
        assert hostile.MARKUP not in found and "<script>document" not in found
        assert "49" not in words(found)
    searched = page(viewer, "odd", show=show, q=hostile.SCRIPT[:100])
    assert "<script>document" not in searched
