"""A server that is part of a demonstration: links that sign in, robots that break; else nothing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import yaml
from starlette.testclient import TestClient

from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.demo.fleet import OFFERED_FAULTS
from amberbox.server.accounts.signin import CODE_LASTS_NS, SignInCodes
from amberbox.server.http.auth import CSRF_HEADER
from amberbox.server.web import text as web_text
from amberbox.sim.faults import catalogue
from tests.server.house import ROBOTS, URL, House, house

CODE = "/api/v1/session/code"
FAULT = "imu_stuck"


@dataclass
class Pretended:
    """A demonstration without processes that records its calls."""

    codes: SignInCodes
    robots: Sequence[str] = tuple(ROBOTS)
    faults: Sequence[str] = (FAULT,)
    acting: dict[str, str] = field(default_factory=dict)
    codes_shown: dict[str, str] = field(default_factory=dict)

    def broken(self) -> Mapping[str, str]:
        return self.acting

    def damage(self, robot: str, fault: str) -> None:
        if fault not in self.faults:
            raise UsageError(f"no fault '{fault}' is offered")
        self.acting[robot] = fault

    def repair(self, robot: str) -> None:
        self.acting.pop(robot, None)

    def codes_at_robots(self) -> Mapping[str, str]:
        return self.codes_shown

    def confirm(self, robot: str) -> None:
        if self.codes_shown.pop(robot, None) is None:
            raise UsageError("no motion waits for its confirmation")

    def end(self) -> None:
        self.acting.clear()


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("house")) as found:
        yield found


@pytest.fixture
def demo(home: House) -> Iterator[Pretended]:
    home.services.demo = made = Pretended(SignInCodes(home.clock))
    yield made
    home.services.demo = None


def here(home: House, address: str = "127.0.0.1") -> TestClient:
    return TestClient(home.app, base_url=URL, client=(address, 50000))


def test_a_link_signs_in_once(home: House, demo: Pretended) -> None:
    code = demo.codes.make("operator")
    client = here(home)
    said = client.post(CODE, json={"code": code})
    assert said.status_code == 200
    assert (said.json()["name"], said.json()["role"]) == ("operator", "operator")
    assert client.get("/api/v1/session").json()["name"] == "operator"
    again = here(home).post(CODE, json={"code": code})
    assert again.status_code == 400
    assert "used" in again.json()["error"]["what"]
    assert "set-cookie" not in again.headers


def test_the_cookie_of_a_link_is_as_after_any_login(home: House, demo: Pretended) -> None:
    said = here(home).post(CODE, json={"code": demo.codes.make("viewer")})
    cookie = said.headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=lax" in cookie
    assert "secure" in cookie


def test_a_link_is_over_after_minutes(home: House, demo: Pretended) -> None:
    code = demo.codes.make("admin")
    home.clock.advance((CODE_LASTS_NS + NS) / NS)
    assert here(home).post(CODE, json={"code": code}).status_code == 400


def test_a_link_is_for_the_machine_itself(home: House, demo: Pretended) -> None:
    code = demo.codes.make("admin")
    assert here(home, "192.0.2.7").post(CODE, json={"code": code}).status_code == 403
    by_proxy = here(home).post(CODE, json={"code": code}, headers={"X-Forwarded-For": "127.0.0.1"})
    assert by_proxy.status_code == 403
    foreign = {"Origin": "https://evil.example"}
    assert here(home).post(CODE, json={"code": code}, headers=foreign).status_code == 403
    form = here(home).post(CODE, content='{"code": "x"}', headers={"Content-Type": "text/plain"})
    assert form.status_code in (415, 422)
    assert here(home).post(CODE, json={"code": code}).status_code == 200


def test_wrong_codes_have_to_wait(home: House, demo: Pretended) -> None:
    client = here(home, "127.0.0.9")
    tried = [client.post(CODE, json={"code": f"guess{n}"}).status_code for n in range(6)]
    assert tried[0] == 400
    assert tried[-1] == 429
    client.close()


def test_codes_are_kept_as_hashes(home: House, demo: Pretended) -> None:
    code = demo.codes.make("admin")
    assert code not in repr(vars(demo.codes))


def test_a_robot_is_broken_and_repaired(home: House, demo: Pretended) -> None:
    viewer = home.client("viewer")
    path = "/api/v1/demo/ropod_002/fault"
    assert viewer.get("/api/v1/demo").json()["faults"] == [FAULT]
    broken = viewer.post(path, json={"fault": FAULT}).json()["robots"]
    assert {"robot": "ropod_002", "fault": FAULT, "code": ""} in broken
    assert demo.acting == {"ropod_002": FAULT}
    assert viewer.post(path, json={"fault": "unheard_of"}).status_code == 400
    assert viewer.delete(path).status_code == 200
    assert demo.acting == {}
    rows = home.client("admin").get("/api/v1/audit", params={"object": "ropod_002"}).json()
    assert [(row["action"], row["details"]) for row in rows[:2]] == [
        ("demo.repair", {"fault": FAULT}), ("demo.break", {"fault": FAULT}),
    ]  # fmt: skip


def test_a_motion_is_confirmed_at_the_robot_by_operators(home: House, demo: Pretended) -> None:
    demo.codes_shown["ropod_002"] = "123456"
    path = "/api/v1/demo/ropod_002/confirm"
    viewer, operator = home.client("viewer"), home.client("operator")
    codes = {one["robot"]: one["code"] for one in viewer.get("/api/v1/demo").json()["robots"]}
    assert codes == {robot: "123456" if robot == "ropod_002" else "" for robot in codes}
    assert viewer.post(path).status_code == 403
    assert [one["code"] for one in operator.post(path).json()["robots"]] == [""] * len(codes)
    assert "no motion waits" in operator.post(path).json()["error"]["what"]
    assert "data-confirm-motion" in operator.get("/robots/ropod_002").text
    assert "data-confirm-motion" not in viewer.get("/robots/ropod_002").text


def test_nobody_breaks_robots_that_are_not_theirs(home: House, demo: Pretended) -> None:
    nurse = home.client("nurse")
    assert [one["robot"] for one in nurse.get("/api/v1/demo").json()["robots"]] == [
        "ropod_001", "ropod_002",
    ]  # fmt: skip
    answer = nurse.post("/api/v1/demo/ropod_003/fault", json={"fault": FAULT})
    assert answer.status_code == 404
    assert demo.acting == {}


def test_breaking_needs_the_token_of_the_session(home: House, demo: Pretended) -> None:
    client = home.client("admin")
    del client.headers[CSRF_HEADER]
    answer = client.post("/api/v1/demo/ropod_001/fault", json={"fault": FAULT})
    assert answer.status_code == 403
    assert demo.acting == {}


def test_elsewhere_there_is_nothing_of_it(home: House) -> None:
    admin = home.client("admin")
    assert here(home).post(CODE, json={"code": "x"}).status_code == 404
    assert here(home).get("/in").status_code == 404
    assert admin.get("/api/v1/demo").status_code == 404
    path = "/api/v1/demo/ropod_001/fault"
    assert admin.post(path, json={"fault": FAULT}).status_code == 404
    assert admin.delete(path).status_code == 404
    assert admin.post("/api/v1/demo/ropod_001/confirm").status_code == 404
    assert "demo-bar" not in admin.get("/").text


def test_the_bar_is_on_every_page_of_a_demonstration(home: House, demo: Pretended) -> None:
    page = home.client("technician").get("/robots/ropod_002").text
    assert 'id="demo"' in page
    assert '<select name="robot">' in page
    assert f'<option value="{FAULT}"' in page
    assert 'id="demo"' not in here(home).get("/sign-in").text
    assert here(home).get("/in").status_code == 200


def test_every_fault_that_is_offered_is_one_with_plain_words() -> None:
    assert set(OFFERED_FAULTS) <= set(catalogue())
    texts = web_text.catalogue().texts
    for fault in OFFERED_FAULTS:
        assert texts[f"demo.faults.{fault}.name"]
        assert texts[f"demo.faults.{fault}.watch"]
    knowledge = Path(__file__).parents[2] / "src/amberbox/sim/folder/fmea.yaml"
    text = knowledge.read_text(encoding="utf-8")
    assert yaml.safe_load(text)
    assert all(
        offer.failure_mode.partition("#")[2] + ":" in text for offer in OFFERED_FAULTS.values()
    )
    assert len({offer.component for offer in OFFERED_FAULTS.values()}) >= 4
