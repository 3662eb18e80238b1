"""Every route with valid and invalid input by its description: no 5xx, nothing undeclared.

``API_EXAMPLES=200`` (``make soak``) tries more of each than ``make test`` has time for.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import run_state_machine_as_test
from schemathesis.checks import not_a_server_error
from schemathesis.generation import GenerationMode
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)
from starlette.testclient import TestClient

from amberbox.server.app import rules
from tests.server.data.filled import fill
from tests.server.house import URL, House, house
from tests.server.people import VICTIM, headers_of, settle
from tests.server.routes import SOCKET

EXAMPLES = int(os.environ.get("API_EXAMPLES", "3"))
CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_schema_conformance,
]
SETTINGS = settings(
    max_examples=EXAMPLES,
    database=None,
    derandomize=EXAMPLES < 100,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)
KNOWN: Mapping[str, str] = {"robot": "ropod_001", "name": VICTIM, "item": "odom"}
"""Existing names, so that not every example ends with 404."""
ADMINS = ("/users", "/groups", "/settings", "/audit", "/key", "/api/v1/robots")
OPERATIONS = sorted(
    (method, path.replace(":path}", "}"))
    for method, path in rules()
    if method != SOCKET and path.startswith(("/api/", "/link/"))
)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    folder = tmp_path_factory.mktemp("house")
    with house(folder / "server", shared=True) as found:
        settle(found)
        fill(found, folder)
        yield found


@pytest.fixture(scope="module")
def schema(home: House) -> Any:
    described = home.client("viewer").get("/api/v1/openapi.json").json()
    for methods in described["paths"].values():
        for said in methods.values():
            said.pop("security", None)  # who asks is decided here, not by chance
    found = schemathesis.openapi.from_dict(described)
    found.config.update(base_url=URL)
    return found


@pytest.fixture(scope="module")
def client(home: House) -> Iterator[TestClient]:
    with TestClient(home.app, base_url=URL, raise_server_exceptions=False) as found:
        yield found


def _principals(method: str, path: str) -> list[str]:
    if path.startswith("/link/"):
        return ["robot"]
    is_admins = method != "GET" or not path.startswith("/api/v1/robots")
    is_admins = is_admins and any(part in path for part in ADMINS)
    return ["technician", "admin"] if is_admins else ["technician"]


TRIED = [(who, *operation) for operation in OPERATIONS for who in _principals(*operation)]


def test_what_is_not_declared_is_found(home: House, client: TestClient) -> None:
    """The same, on a description that leaves a status out: it must fail."""
    described = home.client("viewer").get("/api/v1/openapi.json").json()
    del described["paths"]["/api/v1/users/{name}"]["get"]["responses"]["404"]
    mistaken = schemathesis.openapi.from_dict(described)["/api/v1/users/{name}"]["GET"]
    case = mistaken.Case(path_parameters={"name": "nobody_there"})
    with pytest.raises(BaseExceptionGroup) as found:
        _send(home, client, case, "admin")
    assert "Undocumented status code" in str(found.value.exceptions)


@pytest.mark.parametrize(("who", "method", "path"), TRIED)
def test_answers_are_as_described(
    home: House, schema: Any, client: TestClient, who: str, method: str, path: str
) -> None:
    operation = schema[path][method]
    modes = [operation.as_strategy(generation_mode=mode) for mode in GenerationMode]

    @SETTINGS
    @given(case=st.one_of(modes), known=st.booleans())
    def try_one(case: Any, known: bool) -> None:
        if known:
            _put_known(case)
        _send(home, client, case, who)

    try_one()


def _put_known(case: Any) -> None:
    for values in (case.path_parameters, case.query):
        if isinstance(values, dict):
            for name in set(values) & set(KNOWN):
                values[name] = KNOWN[name]


def _send(home: House, client: TestClient, case: Any, principal: str) -> None:
    case.validate_response(_ask(home, client, case, principal), checks=CHECKS)


def _ask(home: House, client: TestClient, case: Any, principal: str) -> Any:
    sent = case.as_transport_kwargs(base_url=URL)
    sent.pop("cookies", None)
    client.cookies.clear()
    sent["headers"] = {**dict(sent.get("headers") or {}), **headers_of(home, principal, None)}
    return schemathesis.Response.from_any(client.request(**sent))


def test_answers_are_as_described_one_after_another(
    home: House, schema: Any, client: TestClient
) -> None:
    """Results of one route are used as input of others: their links follow from the description."""
    machine: Any = schema.as_state_machine()

    class Visitor(machine):  # type: ignore[misc]  # made at run time
        def call(self, case: Any, **_: Any) -> Any:
            path = case.operation.path
            who = "robot" if path.startswith("/link/") else "admin"
            return _ask(home, client, case, who)

        def validate_response(self, response: Any, case: Any, *_: Any, **__: Any) -> None:
            case.validate_response(response, checks=CHECKS)

    few = settings(SETTINGS, max_examples=max(EXAMPLES // 4, 2), stateful_step_count=6)
    run_state_machine_as_test(Visitor, settings=few)
