"""What the API takes and answers, as a page shows it: made of its OpenAPI and of the guards."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from fastapi import FastAPI

from amberbox.fleet.accounts.actions import ACTIONS
from amberbox.fleet.api.access import Open, Routes, Rule
from amberbox.fleet.api.errors import PROBLEMS
from amberbox.fleet.api.examples import example


@dataclass(frozen=True, slots=True)
class Parameter:
    """A value in the path, the query or a header."""

    name: str
    where: str
    type: str
    required: bool
    about: str


@dataclass(frozen=True, slots=True)
class Answer:
    """A status that can come beyond the problems that all routes may answer."""

    status: str
    about: str
    media: str
    example: str


@dataclass(frozen=True, slots=True)
class Operation:
    """A route: how it is called, who may, what it takes and answers."""

    method: str
    path: str
    anchor: str
    about: str
    who: str
    parameters: list[Parameter]
    body: str
    answers: list[Answer]
    call: str


@dataclass(frozen=True, slots=True)
class Room:
    """The routes that belong together."""

    name: str
    operations: list[Operation]


def described(openapi: Mapping[str, Any], rooms: Mapping[str, Routes], url: str) -> list[Room]:
    """Return what there is, room by room; sockets stand last in theirs."""
    found: dict[str, list[Operation]] = {}
    for routes in rooms.values():
        for (method, path), rule in routes.rules.items():
            said = _said(openapi, method, path)
            if said is None and method != "SOCKET":
                continue  # a page for people
            tag = next(iter(routes.router.tags), "other")
            made = _socket(routes, path, rule, url) if said is None else _operation(
                openapi, method, path, said, rule, url
            )  # fmt: skip
            found.setdefault(str(tag), []).append(made)
    return [
        Room(name, sorted(operations, key=lambda one: (one.method == "SOCKET", one.path)))
        for name, operations in sorted(found.items())
    ]


def _said(openapi: Mapping[str, Any], method: str, path: str) -> dict[str, Any] | None:
    """Return what OpenAPI says of a route; it leaves out that a part of a path may have slashes."""
    found: dict[str, Any] | None = (
        openapi["paths"].get(path.replace(":path}", "}"), {}).get(method.lower())
    )
    return found


def who_may(rule: Rule) -> str:
    """Say in words who gets through."""
    if isinstance(rule.action, Open):
        return f"everybody: {rule.action.reason}"
    action = ACTIONS[rule.action]
    if action.role is None:
        return "the robot itself, with its key"
    reach = {"own": ", for the own account", "server": ", for all robots"}.get(action.reach, "")
    each = ", each sees the own robots" if rule.each else ""
    token = f"; tokens with {action.scope}" if action.scope else "; no tokens"
    return f"{action.role} and above{reach}{each}{token}"


def _operation(
    openapi: Mapping[str, Any],
    method: str,
    path: str,
    said: Mapping[str, Any],
    rule: Rule,
    url: str,
) -> Operation:
    body = _body(openapi, said)
    return Operation(
        method,
        path,
        _anchor(method, path),
        str(said.get("description") or said.get("summary", "")),
        who_may(rule),
        [_parameter(openapi, one) for one in said.get("parameters", ())],
        body,
        list(_answers(openapi, said["responses"])),
        _call(method, path, url, body, rule),
    )


def _socket(routes: Routes, path: str, rule: Rule, url: str) -> Operation:
    endpoints = {getattr(one, "path", ""): one for one in routes.router.routes}
    endpoint = getattr(endpoints.get(path), "endpoint", None)
    about = (inspect.getdoc(endpoint) or "") if endpoint else ""
    call = f"WebSocket {url.replace('http', 'ws', 1)}{path}"
    return Operation(
        "SOCKET", path, _anchor("SOCKET", path), about, who_may(rule), [], "", [], call
    )


def _parameter(openapi: Mapping[str, Any], said: Mapping[str, Any]) -> Parameter:
    schema = said.get("schema", {})
    about = str(said.get("description", ""))
    if "default" in schema and schema["default"] not in ("", None, []):
        about = f"{about}; {schema['default']} unless given".removeprefix("; ")
    required = bool(said.get("required"))
    return Parameter(said["name"], said["in"], _type(openapi, schema), required, about)


def _type(openapi: Mapping[str, Any], schema: Mapping[str, Any]) -> str:
    if "enum" in schema:
        return " | ".join(json.dumps(value) for value in schema["enum"])
    if "anyOf" in schema:
        return " | ".join(_type(openapi, one) for one in schema["anyOf"])
    kind = str(schema.get("type", schema.get("$ref", "any").rpartition("/")[2]))
    low, high = schema.get("minimum"), schema.get("maximum")
    return f"{kind} {low}..{high}" if low is not None and high is not None else kind


def _body(openapi: Mapping[str, Any], said: Mapping[str, Any]) -> str:
    content = said.get("requestBody", {}).get("content", {})
    for media, form in content.items():
        if media == "application/json":
            return json.dumps(example(openapi, form.get("schema", {})), indent=2)
        return str(media)
    return ""


def _answers(openapi: Mapping[str, Any], responses: Mapping[str, Any]) -> Iterable[Answer]:
    for status, said in responses.items():
        if int(status) in PROBLEMS:
            continue
        content = said.get("content", {})
        schema = content.get("application/json", {}).get("schema")
        shown = "" if schema is None else json.dumps(example(openapi, schema), indent=2)
        yield Answer(status, str(said.get("description", "")), ", ".join(content), shown)


def _call(method: str, path: str, url: str, body: str, rule: Rule) -> str:
    """Return how a program asks for it: with a token where one can be enough."""
    parts = ["curl"] + ([f"-X {method}"] if method != "GET" else [])
    action = None if isinstance(rule.action, Open) else ACTIONS[rule.action]
    if action is not None and action.role is None:
        parts.append('-H "Authorization: Robot $ROBOT:$KEY"')
    elif action is not None and action.scope:
        parts.append('-H "Authorization: Bearer $TOKEN"')
    elif action is not None:
        parts.append('-b "amberbox_session=$SESSION"')
        parts += ['-H "X-CSRF-Token: $CSRF"'] if method != "GET" else []
    if body.startswith(("{", "[")):
        compact = json.dumps(json.loads(body))
        parts.append(f"-H 'Content-Type: application/json' -d '{compact}'")
    return " ".join([*parts, f"{url}{path.replace('{robot}', 'ropod_001')}"])


def _anchor(method: str, path: str) -> str:
    return f"{method}-{path}".lower().replace("/", "-").replace("{", "").replace("}", "")


def openapi_of(app: FastAPI, rules: Mapping[tuple[str, str], Rule]) -> dict[str, Any]:
    """Return the OpenAPI of an app, with who may do what: ``x-action``, ``x-role``, ``x-scope``."""
    found = app.openapi()
    found.setdefault("components", {})["securitySchemes"] = _SCHEMES
    for (method, path), rule in rules.items():
        said = _said(found, method, path)
        if said is not None:
            said.update(_extras(rule))
    return found


_SCHEMES: dict[str, Any] = {
    "session": {"type": "apiKey", "in": "cookie", "name": "amberbox_session"},
    "token": {"type": "http", "scheme": "bearer"},
    "robot": {"type": "apiKey", "in": "header", "name": "Authorization",
              "description": "Robot <id>:<key>"},
}  # fmt: skip


def _extras(rule: Rule) -> dict[str, Any]:
    if isinstance(rule.action, Open):
        return {"security": [], "x-open": rule.action.reason}
    action = ACTIONS[rule.action]
    names = ["session"] if action.role is not None else []
    names += ["token"] if action.scope else []
    names += ["robot"] if action.robots else []
    return {
        "security": [{name: []} for name in names],
        "x-action": rule.action,
        "x-role": action.role,
        "x-scope": action.scope,
    }
