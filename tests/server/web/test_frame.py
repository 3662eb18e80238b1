"""The frame of all pages: who gets where, what browsers load, texts, and errors."""

import hashlib
import json
import re
from collections.abc import Iterator
from posixpath import join, normpath

import pytest

from amberbox.server.web import assets
from amberbox.server.web.page import TEMPLATES, as_json, environment
from amberbox.server.web.text import MissingTextError, catalogue, for_browser
from tests.server.house import House, house

UPLOT = {
    "uplot.iife.min.js": "2d27e8ad3d228164525ce213f9dc716f39b4e3aee0cc773fb3491c96cf4921a2",
    "uplot.min.css": "df630c6a8d6f8eeaff264b50f73ce5b114f646ffd9a0bb74f049b0a00135fa04",
}
"""Hashes of uPlot 1.6.31 in youplot 1.0.0: any other file has not been reviewed."""
SCRIPTS = assets.FOLDER / "js"
HTML = {"accept": "text/html"}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("pages"), shared=True) as found:
        yield found


def test_who_is_not_signed_in_is_led_to_sign_in_and_back(home: House) -> None:
    answer = home.client().get("/api/docs?x=1&y=2", headers=HTML, follow_redirects=False)
    assert answer.status_code == 303
    assert answer.headers["location"] == "/sign-in?next=%2Fapi%2Fdocs%3Fx%3D1%26y%3D2"


@pytest.mark.parametrize(
    "next",
    [
        "//evil.example",
        "https://evil.example",
        "/\\evil.example",
        "/\t/evil.example",
        "/\r/e",
        "/\n/e",
        "",
    ],
)
def test_nobody_is_led_elsewhere(home: House, next: str) -> None:
    answer = home.client("viewer").get("/sign-in", params={"next": next}, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, "/")


def test_signing_in_goes_on_to_the_page_that_was_wanted(home: House) -> None:
    page = home.client().get("/sign-in", params={"next": '/robots/x?a="><script>'})
    assert 'data-done="goto:/robots/x?a=&#34;&gt;&lt;script&gt;"' in page.text


@pytest.mark.parametrize(("path", "status"), [("/no/such/page", 404), ("/robots/nobody", 404)])
def test_errors_are_pages_with_a_hint_where_people_look(
    home: House, path: str, status: int
) -> None:
    answer = home.client("viewer").get(path, headers=HTML)
    assert answer.status_code == status
    assert answer.headers["content-type"].startswith("text/html")
    assert catalogue().text(f"error.hint.{status}") in answer.text


def test_errors_are_json_where_programs_ask(home: House) -> None:
    assert home.client("viewer").get("/api/v1/robots/nobody").json()["error"]["what"]


def test_uplot_is_the_one_that_was_looked_at() -> None:
    found = {name: hashlib.sha256(assets.uplot(name)).hexdigest() for name in UPLOT}
    assert found == UPLOT


def test_assets_are_kept_for_ever_and_come_packed(home: House) -> None:
    answer = home.client().get(assets.address("site.css"))
    assert "immutable" in answer.headers["cache-control"]
    assert answer.headers["content-encoding"] == "gzip"
    plain = home.client().get(assets.address("site.css"), headers={"accept-encoding": "identity"})
    assert plain.content == answer.content


def test_assets_of_another_version_are_not_kept(home: House) -> None:
    answer = home.client().get("/static/0000/site.css")
    assert (answer.status_code, answer.headers["cache-control"]) == (200, "no-cache")


@pytest.mark.parametrize("path", ["/static/x/../page.py", "/static/x/%2e%2e/page.py", "/static/x/"])
def test_nothing_but_assets_is_served(home: House, path: str) -> None:
    assert home.client().get(path).status_code == 404


def test_every_module_that_is_imported_or_started_is_there() -> None:
    names = {file.relative_to(SCRIPTS).as_posix() for file in SCRIPTS.rglob("*.js")}
    for file in SCRIPTS.rglob("*.js"):
        asked = re.findall(r'^(?:import|export) .*?from "(\.[^"]+)"', file.read_text(), re.M)
        found = {normpath(join(file.parent.relative_to(SCRIPTS).as_posix(), one)) for one in asked}
        assert found <= names, file.name
    for file in TEMPLATES.rglob("*.html"):
        started = re.findall(r'm\.module\("([\w/-]+)"\)', file.read_text())
        assert {f"{name}.js" for name in started} <= names, file.name


def test_every_picture_that_is_used_is_in_the_sprite() -> None:
    sprite = assets.assets()["icons.svg"].data.decode()
    names = set(re.findall(r'<symbol id="([^"]+)"', sprite))
    used = {name for file in TEMPLATES.rglob("*.html")
            for name in re.findall(r'icon\("([\w-]+)"\)', file.read_text())}  # fmt: skip
    used |= {name for file in SCRIPTS.rglob("*.js")
             for name in re.findall(r'icon\("([\w-]+)"\)', file.read_text())}  # fmt: skip
    assert sorted(used - names) == []


def test_data_for_modules_cannot_leave_its_element() -> None:
    hostile = {"</script><script>alert(1)": "<!-- & ' \u2028"}
    text = as_json(hostile)
    assert not {"<", ">", "&", "'"} & set(text)
    assert json.loads(text) == hostile


def test_what_is_shown_is_escaped_everywhere() -> None:
    assert environment().autoescape is True


def test_every_text_that_is_named_is_in_the_catalogue() -> None:
    texts = catalogue().texts
    for file in TEMPLATES.rglob("*.html"):
        for name in re.findall(r'\bt\("([\w.]+)"', file.read_text()):
            assert name in texts or name.endswith((".", "_")), f"{file.name}: {name}"


def test_every_text_that_modules_name_reaches_some_browser() -> None:
    parts = tuple(file.stem for file in (assets.FOLDER.parent / "strings" / "en").glob("*.yaml"))
    texts = for_browser(parts)
    for file in SCRIPTS.rglob("*.js"):
        for name in re.findall(r'\bt\("([\w.]+)"', file.read_text()):
            assert name in texts or name.endswith((".", "_")), f"{file.name}: {name}"


def test_a_text_that_is_missing_is_an_error() -> None:
    with pytest.raises(MissingTextError, match=r"common\.nonsense"):
        catalogue().text("common.nonsense")


def test_no_page_has_scripts_or_styles_inside() -> None:
    for file in TEMPLATES.rglob("*.html"):
        text = file.read_text()
        assert not re.search(r"<style|\sstyle=|\son\w+=", text), file.name
        for script in re.findall(r"<script([^>]*)>", text):
            assert "src=" in script or 'type="application/json"' in script, file.name
