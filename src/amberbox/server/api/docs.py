"""The documentation of the API: OpenAPI, and a page made of it and of the guards."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request
from fastapi.responses import HTMLResponse, Response
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from amberbox.server.accounts.permissions import ACTIONS
from amberbox.server.http.auth import Open, RouteRule, Routes
from amberbox.server.http.errors import PROBLEMS
from amberbox.server.services.context import Services

_DEEPEST = 5
_KNOWN: Mapping[str, Any] = {
    "robot": "ropod_001",
    "role": "operator",
    "scopes": ["read:status"],
    "groups": ["ward"],
    "what": "there is no robot 'ropod_01'; did you mean 'ropod_001'?",
    "hint": "",
}
_PLAIN: Mapping[str, Any] = {
    "string": "...",
    "integer": 1,
    "number": 1.5,
    "boolean": True,
    "null": None,
}


def example(openapi: Mapping[str, Any], schema: Mapping[str, Any], deep: int = 0) -> Any:
    """Return a value that fits a schema of an OpenAPI document, by and large."""
    if deep > _DEEPEST:
        return "..."
    for key in ("example", "const", "default"):
        if schema.get(key) not in (None, "", []):
            return schema[key]
    if "enum" in schema:
        return schema["enum"][0]
    if "$ref" in schema:
        return example(openapi, _referred(openapi, schema["$ref"]), deep + 1)
    for key in ("anyOf", "oneOf", "allOf"):
        if schema.get(key):
            return example(openapi, schema[key][0], deep + 1)
    kind = schema.get("type")
    if kind == "array":
        return [example(openapi, schema.get("items", {}), deep + 1)]
    if kind == "object":
        inner = schema.get("properties", {})
        return {
            name: _KNOWN.get(name, example(openapi, form, deep + 1)) for name, form in inner.items()
        }
    return _PLAIN.get(str(kind), "...")


def _referred(openapi: Mapping[str, Any], reference: str) -> Mapping[str, Any]:
    found: Any = openapi
    for step in reference.removeprefix("#/").split("/"):
        found = found[step]
    return dict(found)


@dataclass(frozen=True, slots=True)
class RouteParameter:
    """A value in the path, the query or a header."""

    name: str
    where: str
    type: str
    required: bool
    about: str


@dataclass(frozen=True, slots=True)
class RouteAnswer:
    """A status that a route may answer in addition to the problems of all routes."""

    status: str
    about: str
    media: str
    example: str


@dataclass(frozen=True, slots=True)
class RouteDescription:
    """A route: how it is called, who may call it, its parameters and answers."""

    method: str
    path: str
    anchor: str
    about: str
    who: str
    parameters: list[RouteParameter]
    body: str
    answers: list[RouteAnswer]
    call: str


@dataclass(frozen=True, slots=True)
class RouteGroup:
    """The routes that belong together."""

    name: str
    operations: list[RouteDescription]


def describe_routes(
    openapi: Mapping[str, Any], all_routes: Iterable[Routes], url: str
) -> list[RouteGroup]:
    """Return all routes, grouped by router; sockets are last in their group."""
    found: dict[str, list[RouteDescription]] = {}
    for routes in all_routes:
        for (method, path), rule in routes.rules.items():
            described = operation_at(openapi, method, path)
            if described is None and method != "SOCKET":
                continue  # a page for people
            tag = next(iter(routes.router.tags), "other")
            made = _socket(routes, path, rule, url) if described is None else _operation(
                openapi, method, path, described, rule, url
            )  # fmt: skip
            found.setdefault(str(tag), []).append(made)
    return [
        RouteGroup(name, sorted(operations, key=lambda one: (one.method == "SOCKET", one.path)))
        for name, operations in sorted(found.items())
    ]


def operation_at(openapi: Mapping[str, Any], method: str, path: str) -> dict[str, Any] | None:
    """Return what OpenAPI says of a route; it leaves out that a part of a path may have slashes."""
    found: dict[str, Any] | None = (
        openapi["paths"].get(path.replace(":path}", "}"), {}).get(method.lower())
    )
    return found


def who_may(rule: RouteRule) -> str:
    """Return in words who may call a route."""
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
    described: Mapping[str, Any],
    rule: RouteRule,
    url: str,
) -> RouteDescription:
    body = _body(openapi, described)
    return RouteDescription(
        method,
        path,
        _anchor(method, path),
        str(described.get("description") or described.get("summary", "")),
        who_may(rule),
        [_parameter(openapi, one) for one in described.get("parameters", ())],
        body,
        list(_answers(openapi, described["responses"])),
        _call(method, path, url, body, rule),
    )


def _socket(routes: Routes, path: str, rule: RouteRule, url: str) -> RouteDescription:
    endpoints = {getattr(one, "path", ""): one for one in routes.router.routes}
    endpoint = getattr(endpoints.get(path), "endpoint", None)
    about = (inspect.getdoc(endpoint) or "") if endpoint else ""
    call = f"WebSocket {url.replace('http', 'ws', 1)}{path}"
    return RouteDescription(
        "SOCKET", path, _anchor("SOCKET", path), about, who_may(rule), [], "", [], call
    )


def _parameter(openapi: Mapping[str, Any], described: Mapping[str, Any]) -> RouteParameter:
    schema = described.get("schema", {})
    about = str(described.get("description", ""))
    if "default" in schema and schema["default"] not in ("", None, []):
        about = f"{about}; {schema['default']} unless given".removeprefix("; ")
    required = bool(described.get("required"))
    return RouteParameter(
        described["name"], described["in"], _type(openapi, schema), required, about
    )


def _type(openapi: Mapping[str, Any], schema: Mapping[str, Any]) -> str:
    if "enum" in schema:
        return " | ".join(json.dumps(value) for value in schema["enum"])
    if "anyOf" in schema:
        return " | ".join(_type(openapi, one) for one in schema["anyOf"])
    kind = str(schema.get("type", schema.get("$ref", "any").rpartition("/")[2]))
    low, high = schema.get("minimum"), schema.get("maximum")
    return f"{kind} {low}..{high}" if low is not None and high is not None else kind


def _body(openapi: Mapping[str, Any], described: Mapping[str, Any]) -> str:
    content = described.get("requestBody", {}).get("content", {})
    for media, form in content.items():
        if media == "application/json":
            return json.dumps(example(openapi, form.get("schema", {})), indent=2)
        return str(media)
    return ""


def _answers(openapi: Mapping[str, Any], responses: Mapping[str, Any]) -> Iterable[RouteAnswer]:
    for status, described in responses.items():
        if int(status) in PROBLEMS:
            continue
        content = described.get("content", {})
        schema = content.get("application/json", {}).get("schema")
        shown = "" if schema is None else json.dumps(example(openapi, schema), indent=2)
        yield RouteAnswer(status, str(described.get("description", "")), ", ".join(content), shown)


def _call(method: str, path: str, url: str, body: str, rule: RouteRule) -> str:
    """Return an example of a request by a program: with a token if one is sufficient."""
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


def openapi_of(app: FastAPI, rules: Mapping[tuple[str, str], RouteRule]) -> dict[str, Any]:
    """Return the OpenAPI of an app, with who may do what: ``x-action``, ``x-role``, ``x-scope``."""
    found = app.openapi()
    found.setdefault("components", {})["securitySchemes"] = _SCHEMES
    for (method, path), rule in rules.items():
        described = operation_at(found, method, path)
        if described is not None:
            described.update(_extras(rule))
    return found


_SCHEMES: dict[str, Any] = {
    "session": {"type": "apiKey", "in": "cookie", "name": "amberbox_session"},
    "token": {"type": "http", "scheme": "bearer"},
    "robot": {"type": "apiKey", "in": "header", "name": "Authorization",
              "description": "Robot <id>:<key>"},
}  # fmt: skip


def _extras(rule: RouteRule) -> dict[str, Any]:
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


routes = Routes("description", prefix="/api")

_HERE = Path(__file__).parent
_POLICY = (
    "default-src 'none'; style-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
_HTML: dict[int | str, dict[str, Any]] = {200: {"description": "the page"}}
_CSS: dict[int | str, dict[str, Any]] = {
    200: {"description": "its style", "content": {"text/css": {"schema": {"type": "string"}}}}
}


@routes.get("/v1/openapi.json", "own.read")
def read_openapi(request: Request) -> dict[str, Any]:
    """Return the description of the API as OpenAPI 3.1, with who may do what (``x-action``)."""
    return openapi_of(request.app, _rules(request.app))


@routes.get("/docs", "own.read", response_class=HTMLResponse, responses=_HTML)
def read_page(request: Request) -> HTMLResponse:
    """Show this page."""
    app: FastAPI = request.app
    if not hasattr(app.state, "docs_page"):
        app.state.docs_page = _page(app, request.app.state.services)
    headers = {"Content-Security-Policy": _POLICY, "Cache-Control": "no-store"}
    return HTMLResponse(app.state.docs_page, headers=headers)


@routes.get("/docs.css", "own.read", response_class=Response, responses=_CSS)
def read_style() -> Response:
    """Return how this page looks."""
    return Response((_HERE / "docs_page.css").read_text(encoding="utf-8"), media_type="text/css")


def _page(app: FastAPI, services: Services) -> str:
    environment = Environment(
        loader=FileSystemLoader(_HERE), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    found = openapi_of(app, _rules(app))
    listed = describe_routes(found, app.state.routes, services.settings.public_url)
    problems = {status: described["description"] for status, described in PROBLEMS.items()}
    return environment.get_template("docs_page.html").render(
        rooms=listed, problems=problems, version=app.version
    )


def _rules(app: FastAPI) -> dict[tuple[str, str], RouteRule]:
    all_routes: Iterable[Routes] = app.state.routes
    return {where: rule for routes in all_routes for where, rule in routes.rules.items()}
