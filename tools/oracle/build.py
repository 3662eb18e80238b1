"""Install a version of Amberbox into a virtual environment of its own, without a network."""

from __future__ import annotations

import shutil
import subprocess
import sys
import sysconfig
import tarfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
_PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet")


def wheel(version: str, place: Path) -> Path:
    """Return the wheel of a git ref, built below ``place``, or the wheel whose path it is."""
    if version.endswith(".whl"):
        return Path(version).resolve()
    source, built = place / "source", place / "wheel"
    for folder in (source, built):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    archive = place / "source.tar"
    _call("git", "-c", "safe.directory=*", "archive", "-o", str(archive), version, cwd=ROOT)
    with tarfile.open(archive) as packed:
        packed.extractall(source, filter="data")
    options = ["--no-deps", "--no-build-isolation", "--no-index"]
    _call(*_PIP, "wheel", *options, "-w", str(built), str(source), cwd=place)
    (found,) = built.glob("*.whl")
    return found


def install(wheel_path: Path, venv: Path) -> Path:
    """Make ``venv`` anew with this wheel in it; return its interpreter.

    Third-party packages are those of the running interpreter. Its own Amberbox, if it has one,
    is not seen: paths that its ``.pth`` files add are not followed.
    """
    shutil.rmtree(venv, ignore_errors=True)
    _call(sys.executable, "-m", "venv", "--without-pip", str(venv))
    python = venv / "bin" / "python"
    site = packages(python)
    (site / "third_party.pth").write_text(sysconfig.get_path("purelib") + "\n")
    _call(*_PIP, "--python", str(python), "install", "--no-deps", "--no-index", "--no-compile",
          str(wheel_path))  # fmt: skip
    _call(str(python), "-m", "compileall", "-q", str(site / "amberbox"))
    where = _call(str(python), "-c", "import amberbox; print(amberbox.__file__)", cwd=venv).strip()
    if not Path(where).is_relative_to(site):
        raise SystemExit(f"oracle: {where} was imported, not the wheel in {site}")
    return python


def packages(python: Path) -> Path:
    """Return the folder of packages of a virtual environment."""
    (found,) = (python.parents[1] / "lib").glob("python3*/site-packages")
    return found


def _call(*command: str, cwd: Path | None = None) -> str:
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"oracle: {' '.join(command)}\n{done.stdout}{done.stderr}")
    return done.stdout
