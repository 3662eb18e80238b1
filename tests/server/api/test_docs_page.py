"""The API's own documentation: every route is on it, from this server alone, nothing runs."""

from __future__ import annotations

import re
from collections.abc import Iterator
from html.parser import HTMLParser

import pytest

from amberbox.server.accounts.permissions import ACTIONS
from amberbox.server.api.docs import example, who_may
from amberbox.server.app import rules
from amberbox.server.http.auth import Open, RouteRule
from tests.server.house import House, house


class Page(HTMLParser):
    """What a browser would do with a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []
        self.ids: list[str] = []
        self.attributes: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes |= {name for name, _ in attrs}
        found = dict(attrs)
        self.links += [str(found[name]) for name in ("href", "src", "action") if name in found]
        self.ids += [str(found["id"])] if "id" in found else []


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("house"), shared=True) as found:
        yield found


@pytest.fixture(scope="module")
def text(home: House) -> str:
    return str(home.client("viewer").get("/api/docs").text)


def test_every_route_and_socket_is_on_the_page(text: str) -> None:
    shown = re.findall(r'<h3><b class="\w+">(\w+)</b> <code>([^<]+)</code></h3>', text)
    assert sorted(shown) == sorted(one for one in rules() if one[1].startswith(("/api/", "/link/")))
    assert text.count('<p class="who">') == len(shown)


def test_nothing_on_it_runs_or_comes_from_elsewhere(home: House, text: str) -> None:
    page = Page(text)
    assert not {"script", "iframe", "object", "embed", "form", "img", "style"} & set(page.tags)
    assert not {name for name in page.attributes if name.startswith("on") or name == "style"}
    others = [link for link in page.links if not link.startswith("#")]
    assert set(others) == {"docs.css", "v1/openapi.json"}
    assert {link[1:] for link in page.links if link.startswith("#")} == set(page.ids)
    assert len(set(page.ids)) == len(page.ids)
    style = home.client("viewer").get("/api/docs.css").text
    assert "url(" not in style
    assert "@import" not in style


def test_the_browser_is_told_so_too(home: House) -> None:
    answer = home.client("viewer").get("/api/docs")
    policy = answer.headers["content-security-policy"]
    assert "script-src" not in policy
    assert policy.startswith("default-src 'none'; style-src 'self'")


def test_it_shows_nothing_to_strangers(home: House) -> None:
    for path in ("/api/docs", "/api/docs.css", "/api/v1/openapi.json", "/docs", "/openapi.json"):
        answer = home.client().get(path, follow_redirects=False)
        assert answer.status_code in (303, 401, 404), path


def test_the_openapi_says_who_may(home: House) -> None:
    found = home.client("viewer").get("/api/v1/openapi.json").json()
    assert found["openapi"].startswith("3.")
    for (method, path), rule in rules().items():
        if method == "SOCKET" or not path.startswith(("/api/", "/link/")):
            continue
        said = found["paths"][path.replace(":path}", "}")][method.lower()]
        if isinstance(rule.action, Open):
            assert said["x-open"] == rule.action.reason
        else:
            assert said["x-action"] == rule.action
            assert said["x-scope"] == ACTIONS[rule.action].scope
        assert said["description"], f"{method} {path} says nothing about itself"


@pytest.mark.parametrize(
    ("rule", "says"),
    [
        (RouteRule(Open("health")), "everybody: health"),
        (RouteRule("link.connect"), "the robot itself, with its key"),
        (RouteRule("users.read"), "admin and above, for all robots; no tokens"),
        (RouteRule("own.write"), "viewer and above, for the own account; no tokens"),
        (RouteRule("status.read", each=True),
         "viewer and above, each sees the own robots; tokens with read:status"),
    ],
)  # fmt: skip
def test_who_may_is_said_in_words(rule: RouteRule, says: str) -> None:
    assert who_may(rule) == says


def test_examples_fit_what_they_are_examples_of() -> None:
    tree = {"type": "object", "properties": {"inner": {"$ref": "#/components/schemas/Tree"}}}
    openapi = {"components": {"schemas": {"Tree": tree}}}
    schema = {
        "type": "object",
        "properties": {
            "n": {"type": "integer"},
            "kind": {"enum": ["a", "b"]},
            "maybe": {"anyOf": [{"type": "number"}, {"type": "null"}]},
            "list": {"type": "array", "items": {"type": "boolean"}},
            "tree": {"$ref": "#/components/schemas/Tree"},
        },
    }
    found = example(openapi, schema)
    assert (found["n"], found["kind"], found["maybe"], found["list"]) == (1, "a", 1.5, [True])
    assert list(found["tree"]) == ["inner"]
