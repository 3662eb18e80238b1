"""Look at one page of each kind, and at what it is made of."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

from amberbox.demo.browser import Browser
from amberbox.demo.telling import Telling, check

_OPEN = ("/in", "/sign-in", "/licences", "/help")
_SEEN = ("/", "/robots/{robot}", "/robots/{robot}/data", "/robots/{robot}/diagnosis",
         "/recordings",
    "/recordings/{robot}", "/downloads", "/alarms", "/alarms/{alarm}", "/knowledge",
         "/knowledge/{robot}", "/account")  # fmt: skip
_ADMIN = ("/admin", "/admin/users", "/admin/robots", "/admin/teams", "/admin/system",
          "/admin/audit", "/admin/health")  # fmt: skip
_ASSET = re.compile(rb"(?:src|href)=\"(/static/[^\"#]+)")


def visit_pages(telling: Telling, people: Mapping[str, Browser], robot: str, alarm: int) -> None:
    """Open every kind of page as somebody who may see it; raises FailedError for any but 200."""
    nobody = Browser(people["admin"].url)
    visits = [(nobody, path) for path in _OPEN]
    visits += [(people["technician"], path.format(robot=robot, alarm=alarm)) for path in _SEEN]
    visits += [(people["admin"], path) for path in _ADMIN]
    assets = {asset for browser, path in visits for asset in _visit(browser, path)}
    for asset in sorted(assets):
        check(nobody.page(asset).status == 200, f"{asset} is there")
    telling.worked(f"{len(visits)} pages and the {len(assets)} files they are made of answer 200")


def _visit(browser: Browser, path: str) -> Iterator[str]:
    """Open a page; yield what it is made of."""
    reply = browser.page(path)
    check(reply.status == 200, f"the page {path} answers 200 (it was {reply.status})")
    is_html = reply.headers.get("content-type", "").startswith("text/html")
    check(is_html, f"{path} is a page")
    yield from (found.decode() for found in _ASSET.findall(reply.body))
