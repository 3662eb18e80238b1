"""Names that people, scripts and stored data use do not disappear and do not change.

``frozen_names.txt`` is written by hand: new names are added, and none is removed.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from amberbox.testing.clock import wait_until as until
from tests.compatibility import names
from tests.compatibility.heirlooms import Person, amberbox, serving, unpacked
from tests.support.processes import running
from tools.findings import ROOT

FROZEN = Path(__file__).parent / "frozen_names.txt"
PASSWORD = "a long enough passphrase for this"
PLUGIN = '''"""A plugin of another package."""
def evaluate(config, inputs, now): return {}
'''


@cache
def frozen() -> dict[str, names.Names]:
    """Return the sections of the list."""
    found: dict[str, names.Names] = {}
    for line in FROZEN.read_text().splitlines():
        if line.startswith("["):
            section = found.setdefault(line.strip("[]"), {})
        elif line and not line.startswith("#"):
            name, _, words = line.partition(" | ")
            section[name.strip()] = words.strip()
    return found


def compare(section: str, now: names.Names, *, also_new: bool = True) -> None:
    """Fail where a name is gone, and where a new one is not listed."""
    was = frozen()[section]
    gone = [name for name in was if name not in now]
    gone += [
        f"{name}: {word}"
        for name, words in was.items()
        for word in sorted(set(words.split()) - set(now.get(name, words).split()))
    ]
    assert gone == [], f"[{section}] these were there, and somebody may use them"
    new = [name for name in now if name not in was]
    new += [
        f"{name}: {word}"
        for name, words in now.items()
        for word in sorted(set(words.split()) - set(was.get(name, words).split()))
    ]
    assert not also_new or new == [], f"[{section}] these are new: list them in {FROZEN.name}"


@pytest.fixture(autouse=True)
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")


def test_verbs_and_their_options() -> None:
    compare("commands", names.commands())


def test_plugins_and_their_keys() -> None:
    compare("plugins", names.plugins())


def test_the_package_and_its_extras() -> None:
    compare("package", names.package())


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A robot that was recorded and watched by today's version."""
    folder = unpacked("killed", tmp_path_factory.mktemp("recorded")) / "killed"
    shutil.rmtree(folder / "store")
    with running("run", "--quiet", folder, log=folder.parent / "run.log"):
        until(lambda: list(folder.glob("store/watch/*.mcap")), "the watcher writes")
        until(
            lambda: (
                amberbox("incident", folder, "--before", "1s", "--after", "0s").status == 0
                and list(folder.glob("store/incidents/*/ring/*.mcap"))
            ),
            "there is an incident",
        )
    return folder


def test_what_the_box_records_of_itself(recorded: Path, tmp_path: Path) -> None:
    """All channels in the older version's record, most of them in a present one."""
    compare("channels", names.channels(unpacked("linked", tmp_path) / "linked"), also_new=False)
    now = names.channels(recorded)
    for name in frozen()["channels of every run"]:
        assert set(frozen()["channels"][name].split()) <= set(now[name].split()), name


def test_files_of_a_robot(recorded: Path) -> None:
    compare("robot files", names.files(recorded), also_new=False)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fresh") / "server"
    assert amberbox("serve", "cert", "--data", folder, "--host", "localhost").status == 0
    for file in (folder / "tls").iterdir():
        file.rename(folder / file.name)  # set aside: the tests ask without TLS
    return folder


@pytest.fixture(scope="module")
def person(data: Path) -> Iterator[Person]:
    """The admin of a server of today."""
    with serving(data) as url:
        form = f"name=anna&password={PASSWORD}&again={PASSWORD}".replace(" ", "+")
        admin = Person(url)
        kind = {"Content-Type": "application/x-www-form-urlencoded"}
        status, page = admin.send("POST", "/setup", form.encode(), kind)
        assert status == 200, page
        admin.sign_in("anna", PASSWORD)
        yield admin


def test_routes_of_the_api(person: Person) -> None:
    compare("routes", names.routes(person))


def test_addresses_of_pages(person: Person) -> None:
    """A method that no page takes is refused as such, where there is a page."""
    for page in frozen()["pages"]:
        path = page.replace("{", "").replace("}", "")
        status, _ = person.send("DELETE", path, None, {"X-CSRF-Token": person.csrf})
        assert (page, status) == (page, 405)
    assert person.send("DELETE", "/never/was", None, {"X-CSRF-Token": person.csrf})[0] == 404


def test_files_of_a_server(data: Path, person: Person) -> None:
    compare("server files", names.files(data), also_new=False)


def test_tables_of_a_server(data: Path, person: Person) -> None:
    compare("tables", names.tables(data / "server.db"))


def test_words_that_others_send_and_read() -> None:
    """Headers, variables of the environment, kinds of events: somewhere they are still written."""
    text = "\n".join(
        file.read_text()
        for kind in ("py", "html", "js")
        for file in sorted((ROOT / "src" / "amberbox").rglob(f"*.{kind}"))
    )
    assert [word for word in frozen()["words"] if word not in text] == []


def test_plugins_of_other_packages_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    info = tmp_path / "radar-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: radar\nVersion: 1.0\n")
    groups = {group.rpartition(".")[2]: group for group in frozen()["entry points"]}
    (info / "entry_points.txt").write_text(
        "".join(f"[{group}]\nradar_{kind} = radar\n" for kind, group in groups.items())
    )
    (tmp_path / "radar.py").write_text(PLUGIN)
    monkeypatch.syspath_prepend(str(tmp_path))
    found = {(one["kind"], one["name"]) for one in amberbox("plugins", "--json").json()}
    assert {(kind.removesuffix("s"), f"radar_{kind}") for kind in groups} <= found


def test_the_unit_that_was_installed_still_starts(tmp_path: Path) -> None:
    """Units are on other people's computers: the commands in them have to stay."""
    folder = unpacked("killed", tmp_path) / "killed"
    unit = amberbox("install-service", folder).out
    for line in frozen()["unit"]:
        assert line.replace("PYTHON", sys.executable).replace("FOLDER", str(folder)) in unit
    assert amberbox("no-such-verb").status == 2
    assert amberbox("query", tmp_path / "nothing", "x").status == 2
