"""The words on pages: one meaning each, and no words for experts only."""

import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest

from amberbox.server.app import rules
from amberbox.server.web.page import TEMPLATES
from amberbox.server.web.text import EXPERTS, catalogue, groups, words
from tests.server.house import House, house
from tests.server.knowledge import robot as sim

DOCS = Path(__file__).parents[3] / "docs" / "reference" / "words.md"
EXPERT = re.compile(
    r"\b(posteriors?|ambiguity[\s_-]+groups?|(minimal[\s_-]+)?cut[\s_-]*sets?|rpns?"
    r"|isolabilit(y|ies)|engines?)\b",
    re.IGNORECASE,
)
FOR_EXPERTS = "{# details:"
"""The beginning of a template that is shown only under "Details"."""
ELSEWHERE = ("/api/", "/link/", "/static/", "/knowledge", "/licences")
"""Not for everybody, or not in our words."""


def expert_words(text: str) -> list[str]:
    return [found[0] for found in EXPERT.finditer(text)]


@pytest.mark.parametrize(
    "text",
    ["Posteriors", "AMBIGUITY GROUPS", "a cut-set", "minimal cut sets", "the RPN", "isolability",
     "other engines", "rpns", "cutset"],
)  # fmt: skip
def test_expert_words_are_found_in_any_form(text: str) -> None:
    assert expert_words(text)


def test_other_words_are_none() -> None:
    assert expert_words("engineer, group, posted, set of cuts") == []


def as_markdown() -> str:
    """Return all words as docs/reference/words.md has it."""
    lines = [f"# {catalogue().text('help.title')}", "", catalogue().text("help.intro")]
    for heading, found in groups():
        lines += ["", f"## {heading}", "", "| word | meaning |", "|---|---|"]
        lines += [f"| {word.name} | {word.text} |" for word in found]
    return "\n".join(lines) + "\n"


def test_docs_and_pages_say_the_same() -> None:
    assert DOCS.read_text(encoding="utf-8") == as_markdown()


def test_every_word_has_a_name_and_says_more_than_that() -> None:
    for word in words().values():
        assert word.text.endswith(".") and word.text[0].isupper(), word.id
        assert len(word.text) > len(word.name), word.id


def test_words_for_everybody_are_explained_without_those_of_experts() -> None:
    for word in words().values():
        assert word.group == EXPERTS or not expert_words(f"{word.name} {word.text}"), word.id


def test_every_word_with_a_question_mark_is_explained() -> None:
    for file in TEMPLATES.rglob("*.html"):
        for name in re.findall(r'help\("([^"]+)"\)', file.read_text(encoding="utf-8")):
            assert name in words(), f"{file.name}: {name}"


def test_the_catalogue_speaks_plainly_outside_details_and_knowledge() -> None:
    for name, text in catalogue().texts.items():
        parts = name.split(".")
        if parts[0] in ("knowledge", "words") or "details" in parts:
            continue
        assert expert_words(text) == [], name


def test_templates_speak_plainly_outside_details_and_knowledge() -> None:
    for file in TEMPLATES.rglob("*.html"):
        text = file.read_text(encoding="utf-8")
        if file.parent.name != "knowledge" and not text.startswith(FOR_EXPERTS):
            shown = re.sub(r"{{.*?}}|{%.*?%}|{#.*?#}", " ", text, flags=re.DOTALL)
            assert expert_words(shown) == [], file.name


class Shown(HTMLParser):
    """The contents of a page outside ``details``: texts, and accessible labels."""

    ALOUD = ("title", "aria-label", "placeholder", "alt")

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.hidden: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in ("details", "script", "style"):
            self.hidden.append(tag)
        elif not self.hidden:
            self.texts += [value for name, value in attrs if name in self.ALOUD and value]

    def handle_endtag(self, tag: str) -> None:
        if self.hidden and self.hidden[-1] == tag:
            self.hidden.pop()

    def handle_data(self, data: str) -> None:
        if not self.hidden:
            self.texts.append(data)


def shown_by(html: str) -> str:
    parser = Shown()
    parser.feed(html)
    return "\n".join(parser.texts)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("words"), shared=True) as found:
        silent = sim.symptom(sim.NO_SCANS, sim.AT_NS)
        sim.state(found)
        sim.say(found, [(sim.AT_NS, silent), (sim.AT_NS, sim.diagnosis(sim.AT_NS, silent))])
        yield found


def pages() -> list[str]:
    paths = (path.replace("{robot}", "ropod_001") for method, path in rules() if method == "GET")
    parts = tuple(f"/robots/ropod_001/diagnosis/{tab}" for tab in (
        "others", "effects", "tree", "rules", "whatif", "history", "cause"))  # fmt: skip
    return sorted(p for p in paths if "{" not in p and not p.startswith((*ELSEWHERE, *parts)))


def test_no_page_shows_a_word_of_experts(home: House) -> None:
    client = home.client("admin")
    seen = 0
    for path in pages():
        answer = client.get(path)
        if answer.headers.get("content-type", "").startswith("text/html"):
            assert expert_words(shown_by(answer.text)) == [], path
            seen += answer.status_code == 200
    assert seen > 3


def test_what_stands_in_details_is_no_word_of_the_page() -> None:
    page = "<p>fine</p><details><p>posterior</p><details>RPN</details>RPN</details><p>well</p>"
    assert shown_by(page).split() == ["fine", "well"]
    assert expert_words(shown_by('<p title="an engine">fine</p>'))


def test_a_word_is_explained_to_anybody(home: House) -> None:
    told = home.client().get("/help/shelved").json()
    assert told["title"] == "Shelved" and "comes back" in told["text"]
    assert home.client().get("/help/nonsense").status_code == 404


def test_the_page_of_words_has_each_by_its_id(home: House) -> None:
    page = home.client().get("/help").text
    missing = [name for name in words() if f'id="{name}"' not in page]
    assert missing == []
