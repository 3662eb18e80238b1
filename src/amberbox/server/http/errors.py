"""Errors of the API: ``{"error": {"what", "hint"}}`` with the fitting HTTP status."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.link.limits import BUSY, DAMAGED
from amberbox.server.accounts.passwords import TooManyError
from amberbox.server.accounts.signin import MustWaitError, WrongLoginError
from amberbox.server.database import DatabaseBusyError, DatabaseDamagedError
from amberbox.server.services.context import NotFoundError, NotNowError
from amberbox.server.workers.protocol import BrokenError, BusyError


@dataclass(frozen=True, slots=True)
class Problem:
    """What went wrong, and what to do about it."""

    what: str
    hint: str
    code: str = ""


@dataclass(frozen=True, slots=True)
class ErrorBody:
    """The body of every answer that is an error."""

    error: Problem


_TEXT = {"type": "string"}
_SCHEMA: dict[str, Any] = {
    "type": "object",
    "required": ["error"],
    "properties": {
        "error": {
            "type": "object",
            "required": ["what", "hint"],
            "properties": {"what": _TEXT, "hint": _TEXT, "code": _TEXT},
        }
    },
}
"""``ErrorBody``, written out: as a model of each answer of each route it takes long to load."""


def _problem(description: str) -> dict[str, Any]:
    return {"description": description, "content": {"application/json": {"schema": _SCHEMA}}}


PROBLEMS: dict[int | str, dict[str, Any]] = {
    400: _problem("not understood, or not possible as things are"),
    401: _problem("nobody is signed in, or the key does not work"),
    403: _problem("not allowed"),
    404: _problem("not there, or not for you"),
    413: _problem("too large"),
    422: _problem("not of the form that is described here"),
    429: _problem("too often: wait as long as Retry-After says"),
    503: _problem(
        "not now, by its code: busy (try again), not_set_up (no admin yet), damaged (the database)"
    ),
}
"""Error answers of every route; routers declare only their additional answers."""

_STATUS: Mapping[type[AmberboxError], int] = {
    MustWaitError: 429,
    TooManyError: 503,
    WrongLoginError: 401,
    NotFoundError: 404,
    NotNowError: 409,
    DatabaseBusyError: 503,
    DatabaseDamagedError: 503,
    BusyError: 503,
    BrokenError: 500,
    UsageError: 400,
    AmberboxError: 422,
}


def add_handlers(app: FastAPI) -> None:
    """Add the handlers that answer errors in this form to an app."""
    app.add_exception_handler(AmberboxError, answer_known_error)
    app.add_exception_handler(HTTPException, answer_http_error)
    app.add_exception_handler(RequestValidationError, answer_invalid_request)


def error(
    status: int, what: str, hint: str = "", headers: Any = None, code: str = ""
) -> JSONResponse:
    """Return an error as a response; ``code`` distinguishes errors of the same status."""
    content = {
        "what": _encodable(what),
        "hint": _encodable(hint),
        **({"code": code} if code else {}),
    }
    return JSONResponse({"error": content}, status, headers)


def _encodable(text: str) -> str:
    """Replace surrogates, which JSON can contain and UTF-8 cannot encode."""
    return text.encode("utf-8", "replace").decode("utf-8")


def status_of(found: AmberboxError) -> int:
    """Return the HTTP status of an error: that of its nearest base class in the table."""
    return next(_STATUS[cls] for cls in type(found).__mro__ if cls in _STATUS)


async def answer_known_error(_: Request, found: Exception) -> JSONResponse:
    """Return the response to an AmberboxError."""
    assert isinstance(found, AmberboxError)
    wait = {"Retry-After": str(found.seconds)} if isinstance(found, MustWaitError) else None
    status = status_of(found)
    code = DAMAGED if isinstance(found, DatabaseDamagedError) else BUSY if status == 503 else ""
    return error(status, found.what, found.hint, wait, code)


async def answer_http_error(_: Request, found: Exception) -> JSONResponse:
    """Return the response to an HTTPException of a route."""
    assert isinstance(found, HTTPException)
    return error(found.status_code, str(found.detail), "", found.headers)


async def answer_invalid_request(_: Request, found: Exception) -> JSONResponse:
    """Return the response to a request that fails validation: 422, with the first error."""
    assert isinstance(found, RequestValidationError)
    first = found.errors()[0]
    place = ".".join(str(part) for part in first["loc"])
    return error(422, f"{place}: {first['msg']}", "the page /api/docs shows what is expected")
