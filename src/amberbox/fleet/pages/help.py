"""The help: every word that people read on the pages, and what it means."""

from __future__ import annotations

from fastapi import HTTPException, Request, Response
from starlette.responses import JSONResponse

from amberbox.fleet.api.access import Open
from amberbox.fleet.pages.page import Pages, render
from amberbox.fleet.pages.words import EXPERTS, groups, words

routes = Pages()

_OPEN = Open("what words mean: the same for everybody")


@routes.get("/help", _OPEN)
def show_help(request: Request) -> Response:
    """Show all words by what they are about."""
    return render(request, "help.html", groups=list(groups()), experts=EXPERTS)


@routes.get("/help/{word}", _OPEN, response_model=None)
def read_word(word: str) -> Response:
    """Return what one word means, as JSON for the question marks on pages."""
    found = words().get(word)
    if found is None:
        raise HTTPException(404, "there is no such word")
    return JSONResponse({"title": found.name[:1].upper() + found.name[1:], "text": found.text})
