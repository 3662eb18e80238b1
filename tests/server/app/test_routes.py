"""Every router of the API and of the pages is listed; both ask services, and not each other."""

from __future__ import annotations

import pkgutil
from importlib import import_module

from amberbox.server import api, web
from amberbox.server.http.auth import Routes
from amberbox.server.routes import API, PAGES
from tools.check_imports import imports, modules
from tools.findings import ROOT


def test_every_router_is_listed_once() -> None:
    files = [
        import_module(info.name)
        for package in (api, web)
        for info in pkgutil.iter_modules(package.__path__, f"{package.__name__}.")
    ]
    defined = {id(value) for file in files for value in vars(file).values() if _is_router(value)}
    listed = [id(routes) for routes in (*API, *PAGES)]
    assert len(listed) == len(set(listed)) and set(listed) == defined


def _is_router(value: object) -> bool:
    return isinstance(value, Routes)


def test_services_know_neither_api_nor_pages_nor_these_each_other() -> None:
    known = modules(ROOT / "src")
    server = "amberbox.server"
    above = {"services": ("http", "api", "web"), "web": ("api",), "api": ("web",)}
    wrong = [
        (module, found.target)
        for module, path in known.items()
        for found in imports(module, path, known)
        for package, others in above.items()
        if module.startswith(f"{server}.{package}.")
        and found.target.startswith(tuple(f"{server}.{other}." for other in others))
    ]
    assert not wrong
