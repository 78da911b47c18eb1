"""One run held against its own manifest, and its files against each other."""

from __future__ import annotations

from collections.abc import Callable

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.directory import RunDirectory
from wheelleg_exp.run.inventory import odd_entries
from wheelleg_exp.run.listing import effective_status
from wheelleg_exp.run.log import read_log
from wheelleg_exp.verify import check_files, check_results, check_snapshot
from wheelleg_exp.verify.checked_run import Check, RunFindings, Subject

_OF_THE_FILES = (check_files.manifest, check_files.files)
_OF_THE_CONTENT = (
    check_snapshot.params,
    check_snapshot.source,
    check_snapshot.asset,
    check_results.iterations,
    check_results.checkpoints,
    check_results.failure,
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
    checks = [_guarded(check, subject) for check in _OF_THE_FILES]
    odd = odd_entries(run.path)
    if odd:  # behind a link stands what is none of the run's, and a pipe may never end
        checks.append(
            Check("entries", "", [f"{name} is {what}, which may lead anywhere" for name, what in odd.items()])
        )
        skipped = "the run holds something else than files and folders"
        checks += [Check(check.__name__, "", skipped=skipped) for check in _OF_THE_CONTENT]
    else:
        checks += [_guarded(check, subject) for check in _OF_THE_CONTENT]
    return RunFindings(run.path, subject.status, checks)


def _guarded(check: Callable[[Subject], Check], subject: Subject) -> Check:
    """Run a check; a file that it cannot read is its failure, not everybody's."""
    try:
        return check(subject)
    except RunDirectoryError as error:
        return Check(check.__name__, "", [str(error)])
    except Exception as error:  # the files may hold anything
        return Check(check.__name__, "", [f"it cannot be checked: {type(error).__name__}: {error}"])
