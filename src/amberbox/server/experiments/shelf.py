"""The shelf of experiments: their files as they were run or uploaded, by the hash over all of them.

What is on it never changes, so that a run goes on with the diagram it began with and its report can
be made again. Experiments of robots come from the copies of their folders.
"""

from __future__ import annotations

import re
import shutil
import tempfile
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock

from sqlalchemy import Connection, select, update

from amberbox.core.clock import Clock
from amberbox.core.errors import AmberboxError, ConfigurationError, Problem, UsageError
from amberbox.core.files import sync_folder
from amberbox.core.names import derive_id
from amberbox.experiments.experiment import FOLDER, RobotStepOptions
from amberbox.experiments.procedure import Procedure, Step, procedure_of
from amberbox.experiments.profile import SUFFIX, Experiment, list_experiments, read_experiment
from amberbox.experiments.workflow import Flow, Node, Process
from amberbox.server.database import ServerDatabase, upsert_rows
from amberbox.server.experiments.runs import StoredRun
from amberbox.server.ingest.folders import FolderService
from amberbox.server.schema import EXPERIMENT

PLACE = "experiments"
# Largest number of files of an upload, and their size
MOST_FILES = 50
MOST_BYTES = 16 << 20
# Largest body of an upload: JSON, with contents as Base64
UPLOADED_BYTES = MOST_BYTES * 4 // 3 + (1 << 20)
_FILE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}")
_READ = 200


@dataclass(frozen=True, slots=True)
class FoundExperiment:
    """An experiment that can be started, or why not; ``robot`` is empty for an uploaded one."""

    name: str
    robot: str
    experiment: Experiment | None
    problems: Sequence[Problem] = ()
    who: str = ""
    added_ns: int | None = None


@dataclass
class ExperimentShelf:
    """Keeps experiments below the server's folder. Threads may share it."""

    folder: Path
    database: ServerDatabase
    folders: FolderService
    clock: Clock
    _lock: Lock = field(default_factory=Lock)
    _read: OrderedDict[Path, tuple[Experiment | None, Sequence[Problem]]] = field(
        default_factory=OrderedDict
    )

    def of_robot(self, robot: str) -> list[FoundExperiment]:
        """Return the experiments of a robot's folder, and those that were uploaded, by name."""
        found = {one.name: one for one in self.uploaded()}
        try:
            place = self.folders.find(robot)
        except UsageError:  # its folder is not here yet
            return sorted(found.values(), key=lambda one: one.name)
        for path in list_experiments(place / FOLDER):
            experiment, problems = self._judged(path, place)
            relative = tuple(
                Problem(
                    problem.file.removeprefix(f"{place}/"), problem.line, problem.where,
                    problem.what, problem.hint, problem.is_error,
                )
                for problem in problems
            )  # fmt: skip
            name = experiment.name if experiment is not None else path.stem
            found[name] = FoundExperiment(name, robot, experiment, relative)
        return sorted(found.values(), key=lambda one: one.name)

    def uploaded(self) -> list[FoundExperiment]:
        """Return the experiments that people have uploaded, the newest of each name."""
        with self.database.reading() as connection:
            chosen = select(EXPERIMENT).where(EXPERIMENT.c.listed).order_by(EXPERIMENT.c.added_ns)
            rows = connection.execute(chosen).all()
        newest = {row.name: row for row in rows}
        return [
            FoundExperiment(
                row.name, "", self.experiment(row.sha256, row.name), (), row.who, row.added_ns
            )
            for row in newest.values()
        ]

    def find(self, robot: str, name: str) -> FoundExperiment:
        """Return an experiment for a robot by name; raises UsageError where there is none."""
        for one in self.of_robot(robot) if robot else self.uploaded():
            if one.name == name:
                return one
        raise UsageError(f"there is no experiment '{name[:64]}'", "look at the list of experiments")

    def experiment(self, sha256: str, name: str) -> Experiment:
        """Return an experiment that is kept; raises AmberboxError where it cannot be read."""
        return read_kept(self.place(sha256), name, lambda path: self._judged(path, None))

    def procedure(self, run: StoredRun) -> Procedure:
        """Return what a run carries out; raises AmberboxError where it is not kept any more."""
        if run.kind == "unit_test":
            return unit_test(run.name)
        return procedure_of(self.experiment(run.sha256, run.name))

    def place(self, sha256: str) -> Path:
        """Return the folder of an experiment's files."""
        return self.folder / PLACE / sha256

    def keep(self, experiment: Experiment, who: str, *, listed: bool = False) -> None:
        """Keep the files of an experiment; ``listed`` ones can be started on all robots."""
        place = self.place(experiment.sha256)
        if not place.exists():
            place.parent.mkdir(exist_ok=True)
            coming = Path(tempfile.mkdtemp(prefix="coming-", dir=place.parent))
            try:
                for path in experiment.all_files:
                    shutil.copyfile(path, coming / path.name)
                coming.chmod(0o755)
                coming.rename(place)
            except OSError:
                if not place.exists():  # else it came twice at the same time
                    raise
            finally:
                shutil.rmtree(coming, ignore_errors=True)
            sync_folder(place.parent)
        row = {
            "sha256": experiment.sha256, "name": experiment.name, "title": experiment.title,
            "who": who, "added_ns": self.clock.wall_ns(), "listed": listed,
        }  # fmt: skip
        with self.database.begin() as connection:
            upsert_rows(
                connection, EXPERIMENT, [row], ("who", "added_ns", "listed") if listed else ()
            )

    def upload(self, name: str, files: Mapping[str, bytes], who: str) -> Experiment:
        """Judge and keep an uploaded experiment; raises ConfigurationError with all problems.

        ``files`` are those of the experiment and of the ones that it calls, by name.
        """
        if len(files) > MOST_FILES or sum(map(len, files.values())) > MOST_BYTES:
            raise UsageError(
                f"an experiment has at most {MOST_FILES} files and {MOST_BYTES >> 20} MB"
            )
        with tempfile.TemporaryDirectory(dir=self.folder) as scratch:
            place = Path(scratch)
            for file, data in files.items():
                if not _FILE.fullmatch(file):
                    hint = "A-Z a-z 0-9 _ . - and no dot first, 128 characters at most"
                    raise UsageError(f"{file[:80]!r} is no name of a file", hint)
                (place / file).write_bytes(data)
            experiment, problems = read_experiment(place / f"{name}{SUFFIX}")
            if experiment is None:
                raise ConfigurationError([
                    Problem(Path(p.file).name, p.line, p.where, p.what, p.hint, p.is_error)
                    for p in problems
                ])  # fmt: skip
            self.keep(experiment, who, listed=True)
        return self.experiment(experiment.sha256, experiment.name)

    def withdraw(self, connection: Connection, name: str) -> bool:
        """Take an uploaded experiment from the list; return whether it was on it."""
        chosen = update(EXPERIMENT).where(EXPERIMENT.c.name == name, EXPERIMENT.c.listed)
        return connection.execute(chosen.values(listed=False)).rowcount > 0

    def _judged(
        self, path: Path, folder: Path | None
    ) -> tuple[Experiment | None, Sequence[Problem]]:
        """Read a file that never changes, once."""
        with self._lock:
            if path in self._read:
                self._read.move_to_end(path)
                return self._read[path]
        found = read_experiment(path, folder)
        with self._lock:
            self._read[path] = found
            while len(self._read) > _READ:
                self._read.popitem(last=False)
        return found


def read_kept(
    place: Path, name: str,
    read: Callable[[Path], tuple[Experiment | None, Sequence[Problem]]] = read_experiment,
) -> Experiment:  # fmt: skip
    """Return an experiment from the folder of its files; raises AmberboxError if it is not whole.

    Its file may be called otherwise: the name is derived from it.
    """
    for path in list_experiments(place):
        if derive_id(path.name.removesuffix(SUFFIX)) == name:
            experiment, _ = read(path)
            if experiment is not None:
                return experiment
    raise AmberboxError(f"the files of the experiment '{name}' are not whole any more")


def unit_test(name: str) -> Procedure:
    """Return the procedure that carries out one unit test of the robot and nothing else."""
    step = Step("test", name, "robot", robot=RobotStepOptions(test=name))
    nodes = {
        "start": Node("start", "start", (Flow("begin", "test"),)),
        "test": Node("test", "robot", (Flow("end", "done"),)),
        "done": Node("done", "end"),
    }
    names = {"start": "begin", "test": name, "done": "end"}
    return Procedure(name, "", Process(nodes), steps={"test": step}, names=names)
