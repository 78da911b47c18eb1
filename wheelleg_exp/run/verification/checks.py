"""One run held against its own manifest, and its files against each other."""

from __future__ import annotations

from collections.abc import Callable

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.directory import RunDirectory
from wheelleg_exp.run.listing import effective_status
from wheelleg_exp.run.verification import check_files, check_results, check_snapshot
from wheelleg_exp.run.verification.findings import Check, RunFindings
from wheelleg_exp.run.verification.log import read_log
from wheelleg_exp.run.verification.subject import Subject

_CHECKS = (
    check_files.manifest,
    check_files.files,
    check_snapshot.params,
    check_snapshot.source,
    check_snapshot.asset,
    check_results.iterations,
    check_results.checkpoints,
    check_results.recording,
    check_results.exported,
)


def verify_run(run: RunDirectory) -> RunFindings:
    """Hold a run against its manifest, and its files against each other.

    Nothing of the run is executed: checkpoints are loaded as numbers and names alone.

    Raises:
        RunDirectoryError: the manifest is missing or damaged, or its format is not known here.
    """
    manifest = run.manifest()
    subject = Subject(run, manifest, effective_status(manifest), read_log(run.iterations))
    return RunFindings(run.path, subject.status, [_guarded(check, subject) for check in _CHECKS])


def _guarded(check: Callable[[Subject], Check], subject: Subject) -> Check:
    """Run a check; a file that it cannot read is its failure, not everybody's."""
    try:
        return check(subject)
    except RunDirectoryError as error:
        return Check(check.__name__, "", [str(error)])
