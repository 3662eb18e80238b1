"""Constraints pin everything with hashes, the wheel is whole, extras stay optional."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tools.check_files import committed
from tools.check_imports import imports, modules
from tools.findings import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
EXTRAS: dict[str, list[str]] = PROJECT["project"]["optional-dependencies"]
CONSTRAINTS = ["all", "test", "bench"]
SERVER = ["argon2", "deltalake", "fastapi", "sqlalchemy", "starlette", "uvicorn", "websockets"]
"""What only the server has installed, and of these the link ``websockets``."""
OPTIONAL = ["pyarrow", "duckdb", "tsdownsample", "matplotlib", "zmq", "msgpack", "pandas"]
OPTIONAL += [
    "polars",
    "mcap",
    "mcap_ros1_support",
    "foxglove",
    "pytest",
    "zenoh",
    "cyclonedds",
    "PIL",
]
IN_PYTEST = ("amberbox.testing", "amberbox.experiments.pytest_plugin", "amberbox.sim.folder.tests")
"""What only pytest imports."""


def pins(file: str) -> dict[str, tuple[str, int]]:
    """Return version and number of hashes of each package in a constraints file."""
    text = (ROOT / "constraints" / f"{file}.txt").read_text().replace("\\\n", " ")
    found: dict[str, tuple[str, int]] = {}
    for line in text.splitlines():
        package, *hashes = line.replace(' ; platform_machine == "x86_64"', "").split()
        name, _, version = package.partition("==")
        assert version and re.fullmatch(r"[\w.-]+", name), line
        assert all(re.fullmatch(r"--hash=sha256:[0-9a-f]{64}", one) for one in hashes), line
        found[canonicalize_name(name)] = (version, len(hashes))
    return found


@pytest.mark.parametrize("name", CONSTRAINTS)
def test_every_package_is_pinned_with_hashes_and_nothing_else_is_said(name: str) -> None:
    assert len(pins(name)) > 20
    assert all(hashes for _, hashes in pins(name).values())


@pytest.mark.parametrize("name", CONSTRAINTS)
def test_pins_lie_in_the_ranges_we_promise(name: str) -> None:
    pinned = pins(name)
    wanted = [*PROJECT["project"]["dependencies"], *PROJECT["build-system"]["requires"]]
    wanted += [text for extra in _extras(name) for text in EXTRAS[extra]]
    for requirement in map(Requirement, wanted):
        if requirement.name != "amberbox":
            version, _ = pinned[canonicalize_name(requirement.name)]
            assert requirement.specifier.contains(version), requirement


def test_tests_run_with_the_versions_that_users_get() -> None:
    everything = pins("test")
    assert {package: everything[package] for package in pins("all")} == pins("all")


def test_all_names_every_extra_but_those_of_our_own_work() -> None:
    (own,) = map(Requirement, EXTRAS["all"])
    assert own.extras == set(EXTRAS) - {"all", "test", "bench"}


def test_what_we_import_is_what_we_declare() -> None:
    """At module level only required packages are imported, in functions also those of extras."""
    always = set(map(_package, PROJECT["project"]["dependencies"]))
    sometimes = always | {_package(text) for extra in _extras("all") for text in EXTRAS[extra]}
    sometimes |= {"pandas", "polars"}  # users who ask for their tables have them
    own = {
        package: always | {_package(text) for text in EXTRAS[extra]}
        for package, extra in {
            "server": "server",
            "demo": "server",
            "link": "link",
            "agent": "link",
        }.items()
    }  # who runs these has installed their extra
    known = modules(ROOT / "src")
    undeclared = {
        f"{module}:{entry.line} imports {entry.target}"
        for module, path in known.items()
        for entry in imports(module, path, known)
        if _distribution(entry.target)
        not in (sometimes if entry.lazy else own.get(f"{module}.".split(".")[1], always)) | {None}
        and not module.startswith(IN_PYTEST)
    }
    assert undeclared == set()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """Build the wheel from the committed files alone."""
    folder = tmp_path_factory.mktemp("wheel")
    for path in committed(ROOT):
        if path.startswith(("src/", "pyproject.toml", "README.md", "LICENSE")):
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / path, folder / path)
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps"]
    command += ["--no-build-isolation", "--wheel-dir", str(folder / "dist"), str(folder)]
    subprocess.run(command, check=True, capture_output=True)
    (built,) = (folder / "dist").glob("amberbox-*.whl")
    return zipfile.ZipFile(built)


def test_the_wheel_holds_every_file_of_the_package(wheel: zipfile.ZipFile) -> None:
    ours = {path.removeprefix("src/") for path in committed(ROOT) if path.startswith("src/")}
    assert "amberbox/py.typed" in ours
    assert ours <= set(wheel.namelist())


def test_the_wheel_holds_licence_and_program(wheel: zipfile.ZipFile) -> None:
    names = {Path(name).name: name for name in wheel.namelist()}
    licence = wheel.read(names["LICENSE"]).decode()
    assert licence == (ROOT / "LICENSE").read_text()
    assert "Apache License" in licence
    assert b"amberbox = amberbox.__main__:main" in wheel.read(names["entry_points.txt"])


def test_every_module_imports_with_none_of_the_optional_packages() -> None:
    """Recording needs none of them; a package is imported where it is used."""
    program = f"""
import importlib, pkgutil, sys
for name in {OPTIONAL}:
    sys.modules[name] = None
import amberbox
for name in {SERVER}:
    sys.modules[name] = None
for info in pkgutil.walk_packages(amberbox.__path__, "amberbox."):
    others = info.name.startswith(("amberbox.server.", "amberbox.demo.", {IN_PYTEST[1]!r}))
    if not others and not info.name.endswith("__main__"):
        importlib.import_module(info.name)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stderr == ""
    assert done.returncode == 0


def _package(requirement: str) -> str:
    return canonicalize_name(Requirement(requirement).name)


def _distribution(module: str) -> str | None:
    """Return the package that brings a module; None if Python does, or we."""
    top = module.partition(".")[0]
    if top in sys.stdlib_module_names or top == "amberbox":
        return None
    brought = {
        "yaml": "pyyaml",
        "zmq": "pyzmq",
        "paho": "paho-mqtt",
        "bson": "pymongo",
        "PIL": "pillow",
        "foxglove": "foxglove-sdk",
        "argon2": "argon2-cffi",
        "zenoh": "eclipse-zenoh",
        "can": "python-can",
        "serial": "pyserial",
    }
    return brought.get(top, canonicalize_name(top))


def _extras(name: str) -> list[str]:
    """Return the extras of a constraints file."""
    own = {"test", "bench"}
    return ["bench"] if name == "bench" else [one for one in EXTRAS if one not in own - {name}]
