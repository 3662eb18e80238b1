"""Answers that finished experiments and unit tests give to the open diagnosis of a robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec

from amberbox.blackbox.robot_folder.folder import RobotFolder
from amberbox.blackbox.store.store import is_store, open_store, submit
from amberbox.consult.folder_knowledge import load_knowledge
from amberbox.core.given_answers import RecordedAnswer
from amberbox.core.types import Diagnosis, RunKind
from amberbox.diagnosis.fmea.runs import answers_of_run
from amberbox.diagnosis.knowledge import Knowledge
from amberbox.monitoring.plan_loader import load_plan
from amberbox.monitoring.watcher import ANSWER_KIND
from amberbox.monitoring.watcher_journal import retained_findings


def answers_to(
    diagnosis: Diagnosis, knowledge: Knowledge, kind: RunKind, name: str, verdict: str
) -> dict[str, str]:
    """Return what a finished run answers to a diagnosis, by test.

    Tests that see no failure mode of any hypothesis are left out, unless they are proposed.
    """
    given = answers_of_run(knowledge.fmea, kind, name, verdict)
    suspected = {fault for one in diagnosis.hypotheses for fault in one.faults}
    proposed = {test.id for test in diagnosis.next_tests}
    return {
        test: answer
        for test, answer in given.items()
        if test in proposed or suspected & {d.cause for d in knowledge.checks[test].detections}
    }


def store_run_answers(
    folder: RobotFolder, kind: RunKind, verdicts: Mapping[str, str], who: str
) -> Sequence[RecordedAnswer]:
    """Leave the answers of finished runs for the robot's watcher; return them.

    ``verdicts`` are by the name of the experiment or unit test. They count in the diagnoses that
    are open now; without one, and without failure modes, nothing is stored.
    """
    if not is_store(folder.store_path):
        return ()
    store = open_store(folder.store_path)
    diagnoses = retained_findings(store).diagnoses.values()
    knowledge = load_knowledge(folder, load_plan(folder)[0])[0] if diagnoses else None
    if knowledge is None:
        return ()
    given = [
        RecordedAnswer(diagnosis.id, test, answer, who)
        for diagnosis in diagnoses
        for name, verdict in verdicts.items()
        for test, answer in answers_to(diagnosis, knowledge, kind, name, verdict).items()
    ]
    for one in given:
        submit(store, ANSWER_KIND, msgspec.to_builtins(one))
    return given
