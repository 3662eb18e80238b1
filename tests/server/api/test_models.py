"""Models of robots over HTTP: structure and consistency, bounded, and from the command line."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from starlette.testclient import TestClient

from amberbox.server.services import knowledge
from tests.cli.test_consistency import POLYBOX, POWER
from tests.cli.test_structure import WHEEL
from tests.server.house import House, house
from tests.server.knowledge import robot as sim

PATH = "/api/v1/robots/ropod_001"
BROKEN = WHEEL.replace("[torque, current]", "[torque, curent]")
# 2 unknowns in 24 equations: 2,024 sets
MANY = "kind: equations\nunknowns: [a, b]\nequations:\n" + "".join(
    f"  e{number}: {{variables: [a, b], faults: [f{number}]}}\n" for number in range(24)
)


MOTION = """\
kind: equations
unknowns: [v]
known: {encoder: wheel.rate, odometer: odom.speed}
equations:
  wheel: {solve: {v: 0.1 * encoder}, component: wheel}
  odometer: {residual: odometer - v, component: odometry}
residuals:
  speed: {equations: [wheel, odometer], threshold: 0.05}
  alone: {equations: [odometer]}
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("house")) as found:
        more = {
            "wheel": WHEEL, "broken": BROKEN, "many": MANY, "power": POWER, "polybox": POLYBOX,
            "motion": MOTION, "other": "kind: equation\n", "camera": "width: 640\n",
        }  # fmt: skip
        sim.hand_in(found, more={f"models/{n}.yaml": text.encode() for n, text in more.items()})
        sim.state(found)
        yield found


@pytest.fixture
def viewer(home: House) -> TestClient:
    return home.client("viewer")


def got(client: TestClient, path: str, **query: Any) -> Any:
    answer = client.get(f"{PATH}/{path}", params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()


def refused(client: TestClient, path: str, **query: Any) -> str:
    answer = client.get(f"{PATH}/{path}", params=query)
    assert answer.status_code == 400, answer.text
    return str(answer.json()["error"]["what"])


def test_models_are_listed_with_what_is_wrong(viewer: TestClient) -> None:
    lines = {line["name"]: line for line in got(viewer, "models")}
    fine = {name for name, line in lines.items() if not line["problems"]}
    assert {"polybox", "power", "many", "wheel"} <= fine and "other" not in fine
    assert lines["broken"]["problems"][0].startswith("models/broken.yaml:5: equations.motor: there")
    assert (lines["other"]["kind"], lines["wheel"]["kind"]) == ("", "equations")


def test_residuals_and_what_cannot_be_computed(viewer: TestClient) -> None:
    found = got(viewer, "structure", model="motion", show="residuals")["residuals"]
    assert [one["name"] for one in found] == ["speed", "alone"]
    assert found[0]["components"] == ["wheel", "odometry"] and found[0]["threshold"] == 0.05
    assert found[0]["reads"] == ["odom.speed", "wheel.rate"] and not found[0]["problem"]
    assert "1 equations for 1 unknowns" in found[1]["problem"]
    asked = {"model": "motion", "residual": "speed", "from": "2026-01-05T08:00:00Z"}
    hour = {**asked, "to": "2026-01-05T09:00:00Z"}
    assert refused(viewer, "residual", **hour) == "is not recorded: odom.speed, wheel.rate"
    assert "at most 6 h" in refused(viewer, "residual", **asked, to="2026-01-05T16:00:00Z")
    wrong = {**hour, "residual": "sped"}
    assert refused(viewer, "residual", **wrong).endswith("did you mean 'speed'?")
    assert viewer.get(f"{PATH}/residual", params=asked).status_code == 422


def test_what_a_model_of_equations_can_show(viewer: TestClient) -> None:
    found = got(viewer, "structure", model="wheel")
    assert found["not_told_from"]["weak"] == ["weak", "drags"]
    assert (found["redundancy"], found["incomplete"]) == (2, "")
    assert got(viewer, "structure", model="wheel", show="mso")["count"] == 4
    asked = {"show": "sensor_sets", "measurable": ["torque", "speed"]}
    assert got(viewer, "structure", model="wheel", **asked)["sensor_sets"] == [["torque"]]
    matrix = got(viewer, "structure", model="wheel", show="matrix")
    assert {one["part"] for one in matrix["equations"]} == {"over"}
    encoder = next(one for one in matrix["equations"] if one["name"] == "encoder")
    assert (encoder["known"], encoder["faults"]) == (["encoder"], ["encoder"])
    assert refused(viewer, "structure", model="wheels").endswith("did you mean 'wheel'?")
    assert "models of kind: equations: which one?" in refused(viewer, "structure")
    assert "models/broken.yaml:5: equations.motor" in refused(viewer, "structure", model="broken")
    assert "no unknown 'tork'" in refused(
        viewer, "structure", model="wheel", show="sensor_sets", measurable="tork"
    )


def test_which_modes_agree(viewer: TestClient) -> None:
    found = got(viewer, "consistency", model="power", observe=["b1.out=on"])
    assert found["conflicts"] == [["b2"]]
    assert found["diagnoses"] == [["b2=tripped"], ["b2=unknown"]] and found["ranks"] == [3, 6]
    assert got(viewer, "consistency", model="power", most=1)["incomplete"] == (
        "there are more than 1 diagnoses"
    )
    assert "did you mean 'b1.out'" in refused(
        viewer, "consistency", model="power", observe="b1.ou=on"
    )


def test_a_search_without_end_does_no_harm(
    viewer: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = got(viewer, "structure", model="many", show="mso", most=50)
    assert (found["count"], found["incomplete"]) == (50, "there are more than 50 sets")
    monkeypatch.setattr(knowledge, "LIMIT_S", 0.01)
    answer = viewer.get(f"{PATH}/structure", params={"model": "many", "show": "mso"})
    assert answer.status_code == 422
