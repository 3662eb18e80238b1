"""Whose work the pages use, and under which licence."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib.metadata import distribution

from fastapi import Request, Response

from amberbox.fleet.api.access import Open
from amberbox.fleet.pages.assets import uplot
from amberbox.fleet.pages.page import Pages, render

routes = Pages()


@routes.get("/licences", Open("whose work the pages use is for everybody to know"))
def show(request: Request) -> Response:
    """Show the licences of what is sent to browsers."""
    return render(request, "licences.html", notice=_notice(), carrier=_carrier())


def _notice() -> str:
    """Return what uPlot says of itself at the head of its file."""
    head = uplot("uplot.iife.min.js")[:2000].decode("utf-8", "replace")
    found = re.match(r"\s*/\*!(.*?)\*/", head, re.DOTALL)
    return found[1].strip() if found else ""


def _carrier() -> Mapping[str, str]:
    """Return what the package that carries it is called, and its licence as it is installed."""
    package = distribution("youplot")
    files = [file for file in package.files or () if file.name.upper().startswith("LICENSE")]
    text = "\n\n".join(file.read_text() for file in files)
    return {"name": package.metadata["Name"], "version": package.version, "licence": text}
