"""A model of the server on a robot: signed by a person, fetched over the link, checked."""

from __future__ import annotations

import hashlib
import socket
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from amberbox.agent.join import write_key
from amberbox.agent.model_action import Config, run, takes_models
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.cli.main import main
from amberbox.client import credentials, signing_key
from amberbox.core.command import MODEL_INSTALL
from amberbox.core.errors import NotStartedError
from amberbox.detection.learn import learn
from amberbox.detection.model_file import load_model, save_model
from amberbox.link.connection import link_options
from amberbox.link.uploader import HttpTransport
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.learning import models
from amberbox.testing.actions import ManualContext
from amberbox.testing.detectors import nominal_missions
from tests.support.commanded import ROBOT, Commanded, commanded
from tests.support.commands import ANNA

MODEL = "detectors.model"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Commanded]:
    """A robot whose configuration lets signed commands install models, and its server."""
    detection = f"detection: {{model: ../{MODEL}, from_server: yes}}\n"
    folder = tmp_path_factory.mktemp("world")
    with commanded(folder, "tcp://127.0.0.1:9", robot_yaml=detection) as found:
        yield found


@pytest.fixture(autouse=True)
def at_home(world: Commanded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Anna's computer, with her key."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv(credentials.VARIABLE, world.tokens["anna"])
    monkeypatch.setattr("amberbox.core.ed25519.new_private_key", lambda: ANNA.private)
    signing_key.make_key("anna")


def stored(world: Commanded, name: str, seed: int, *, team: bool = False) -> Path:
    """Let the server have learnt a model; return the path of its file."""
    wanted = models.LearnRequest([ROBOT], ["guard"], team=team)
    database = ServerDatabase(world.data / FILE)
    with database.begin() as connection:
        model = models.add(connection, time.time_ns(), "anna", name, wanted)
        assert models.change(connection, model.id, only=("queued",), state="failed")
    path = world.data / models.FOLDER / model.id / model.file
    path.parent.mkdir(parents=True)
    origin = {"name": name, "version": model.version, "team": team}
    found = learn(nominal_missions(seed=seed), ["guard"])
    save_model(replace(found, origin={**found.origin, **origin}), path)
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    with database.begin() as connection:
        done = {"state": "done", "sha256": sha256, "bytes": path.stat().st_size}
        assert models.change(connection, model.id, only=("failed",), **done)
    database.close()
    return path


def installed(world: Commanded) -> Path:
    return world.folder.parent / MODEL


def test_a_signed_model_is_installed_and_another_one_in_its_place(world: Commanded) -> None:
    first = stored(world, "drive", 1)
    assert main(["model", "install", world.where, "drive"]) == 0
    assert installed(world).read_bytes() == first.read_bytes()
    second = stored(world, "drive", 2)
    assert main(["model", "install", world.where, "drive:2"]) == 0
    assert installed(world).read_bytes() == second.read_bytes()
    assert load_model(installed(world)).origin["version"] == 2


def test_another_file_than_the_signed_one_and_one_of_no_use_stay_away(
    world: Commanded, capsys: pytest.CaptureFixture[str]
) -> None:
    before = stored(world, "kept", 3)
    assert main(["model", "install", world.where, "kept"]) == 0
    stored(world, "changed", 4).write_bytes(before.read_bytes())
    assert main(["model", "install", world.where, "changed"]) == 1
    assert "another file than the one that was signed" in capsys.readouterr().err
    assert main(["model", "install", world.where, "kept:9"]) == 1
    stored(world, "pair", 5, team=True)
    assert main(["model", "install", world.where, "pair"]) == 1
    assert "only the server runs" in capsys.readouterr().err
    assert installed(world).read_bytes() == before.read_bytes()


@pytest.mark.parametrize("sha256", ["0" * 64, "../../server.db"])
def test_a_robot_fetches_nothing_that_no_command_of_its_own_names(
    world: Commanded, sha256: str
) -> None:
    assert main(["command", "send", world.where, MODEL_INSTALL, f"sha256={sha256}"]) == 1
    path = stored(world, "unasked", 6)
    get = HttpTransport(link_options(load_folder(world.folder)), lambda: None)
    known = hashlib.sha256(path.read_bytes()).hexdigest()
    assert get("GET", f"/link/v1/models/{known}", {}, b"").status == 404
    get.close()


def test_a_server_that_is_away_and_a_stop_leave_the_model_in_use(tmp_path: Path) -> None:
    folder, model = tmp_path / "robot", tmp_path / MODEL
    folder.mkdir()
    model.write_bytes(b"in use")
    (folder / "black_box.yaml").write_text("- sim: {}\n")
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        server = f"server: {{url: 'http://127.0.0.1:{silent.getsockname()[1]}'}}\n"
        detection = f"detection: {{model: ../{MODEL}, from_server: yes}}\n"
        (folder / "robot.yaml").write_text(f"id: r1\n{server}{detection}")
        write_key(folder, "abr_key")
        asked = ManualContext({"sha256": "0" * 64})
        with pytest.raises(NotStartedError, match="cannot be reached"):
            run(Config(str(folder)), asked)
        silent.listen()
        asked.stop()
        with pytest.raises(NotStartedError, match="it was stopped"):
            run(Config(str(folder)), asked)
    assert model.read_bytes() == b"in use"


def test_a_robot_whose_folder_does_not_say_so_takes_no_models(tmp_path: Path) -> None:
    (tmp_path / "black_box.yaml").write_text("- sim: {}\n")
    server = "server: {url: 'http://127.0.0.1:9'}\n"
    yes = "detection: {model: ../a.model, from_server: yes}\n"
    texts = {f"{server}detection: {{model: ../a.model}}\n": False, yes: False, server: False}
    for text, takes in {**texts, server + yes: True}.items():
        (tmp_path / "robot.yaml").write_text(f"id: r1\n{text}")
        assert takes_models(load_folder(tmp_path)) is takes
