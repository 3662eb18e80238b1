"""Compare two versions of Amberbox from outside: ``python -m tools.oracle --base A --new B``."""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from tools.oracle import inputs, mutants, robot
from tools.oracle.book import Book
from tools.oracle.build import install, packages, wheel
from tools.oracle.compare import differences, report
from tools.oracle.side import Side

Part = Callable[[Side, Path], None]


def parts() -> Mapping[str, Part]:
    """Return what can be captured, by name."""
    from importlib import import_module

    found: dict[str, Part] = {name: _on_robot(name) for name in robot.PARTS}
    found["server"] = import_module("tools.oracle.server").capture
    return found


def _on_robot(name: str) -> Part:
    return lambda side, out: robot.PARTS[name](side, Book(side, out))


def capture(python: Path, place: Path, out: Path, names: Iterable[str]) -> None:
    """Capture parts of an installed version into ``out``; each begins in an empty folder."""
    known = parts()
    for name in names:
        began_s = time.monotonic()
        scratch = place / "s"
        shutil.rmtree(scratch, ignore_errors=True)
        with Side(python, scratch) as side:
            known[name](side, out / name)
        _say(f"  {name}: {time.monotonic() - began_s:.1f} s")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one comparison; 0 equal, 1 different."""
    parser = argparse.ArgumentParser(prog="python -m tools.oracle", description=__doc__)
    parser.add_argument("--base", metavar="REF", help="git ref or wheel of the old version")
    parser.add_argument("--new", metavar="REF", default="HEAD", help="of the new one (HEAD)")
    parser.add_argument(
        "--twice", metavar="REF", help="two captures of one version: are they equal"
    )
    parser.add_argument("--mutants", metavar="REF", help="are all planted mistakes seen")
    parser.add_argument("--part", action="append", help="only this part; again for more")
    parser.add_argument("--mutant", action="append", help="only this mutant; again for more")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="work in this folder, leave it")
    parser.add_argument("--list", action="store_true", help="list parts and mutants")
    options = parser.parse_args(arguments)
    if options.list:
        print(*parts(), *(f"{m.name}: {', '.join(m.parts)}" for m in mutants.MUTANTS), sep="\n")
        return 0
    if not (options.base or options.twice or options.mutants):
        parser.error("--base, --twice or --mutants")
    place = (options.keep or Path(tempfile.mkdtemp(prefix="oracle-"))).resolve()
    place.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(place / "inputs", ignore_errors=True)
    inputs.write_all(place / "inputs")
    names = options.part or list(parts())
    try:
        if options.mutants:
            return _mutants(options.mutants, place, options.part, options.mutant)
        base, new = (options.twice,) * 2 if options.twice else (options.base, options.new)
        return _compare(base, new, place, names)
    finally:
        if options.keep is None:
            shutil.rmtree(place, ignore_errors=True)


def _compare(base: str, new: str, place: Path, names: Sequence[str]) -> int:
    for side, version in (("base", base), ("new", new)):
        _say(f"{side}: {version}")
        out = place / side
        shutil.rmtree(out, ignore_errors=True)
        capture(_installed(version, place), place, out, names)
    outs = place / "base", place / "new"
    found = differences(*outs)
    total = sum(1 for path in outs[0].rglob("*") if path.is_file())
    if found:
        print(report(*outs, found))
        print(f"different: {len(found)} of {total} records")
        return 1
    print(f"equal: {total} records of {len(names)} parts")
    return 0


def _installed(version: str, place: Path) -> Path:
    """Install a version; both sides have the same paths, one after the other."""
    return install(wheel(version, place), place / "venv")


def _mutants(
    version: str, place: Path, only: Sequence[str] | None, wanted: Sequence[str] | None
) -> int:
    """Plant each mistake in the installed package; return 1 if one is not seen."""
    python = _installed(version, place)
    package = packages(python) / "amberbox"
    base, out = place / "base", place / "mutant"
    shutil.rmtree(base, ignore_errors=True)
    missed = []
    chosen = [
        mutant
        for mutant in mutants.MUTANTS
        if (not only or set(only) & set(mutant.parts)) and (not wanted or mutant.name in wanted)
    ]
    for mutant in sorted(chosen, key=lambda mutant: mutant.parts):
        for name in mutant.parts:
            if not (base / name).exists():
                capture(python, place, base, [name])
        seen = _is_seen(mutant, python, package, place, base, out)
        print(f"{'seen' if seen else 'MISSED'}  {mutant.name}: {seen}", flush=True)
        if not seen:
            missed.append(mutant.name)
    print(f"{len(chosen) - len(missed)} of {len(chosen)} mutants seen")
    return 1 if missed else 0


def _is_seen(
    mutant: mutants.Mutant, python: Path, package: Path, place: Path, base: Path, out: Path
) -> str:
    """Return where a mutant shows; empty if nowhere."""
    with mutants.planted(mutant, package):
        for name in mutant.parts:
            shutil.rmtree(out, ignore_errors=True)
            try:
                capture(python, place, out, [name])
            except Exception as error:  # it broke so much that the capture cannot go on
                return f"{name}: {type(error).__name__} {str(error)[:80]}"
            found = differences(base / name, out / name)
            if found:
                return f"{name}: {len(found)} records, first {found[0]}"
    return ""


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
