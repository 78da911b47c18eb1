"""Going on with a run that was stopped, killed or is to be longer, as if it had never ended."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

from wheelleg_exp.config.changes import Change
from wheelleg_exp.config.problems import join, parts
from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.files import read_text, sha256
from wheelleg_exp.jobs.display import Display
from wheelleg_exp.jobs.kept_robot import kept_model_digest
from wheelleg_exp.jobs.resume.changes import changed, changed_texts, kept_tree, record
from wheelleg_exp.jobs.resume.differences import brief, differences_now
from wheelleg_exp.jobs.resume.drop_past_checkpoint import drop_past_checkpoint
from wheelleg_exp.jobs.resume.loading import learning_rate_of, load, recipe_of
from wheelleg_exp.jobs.resume.others import require_as_many, tell_others
from wheelleg_exp.jobs.resume.point import ResumePoint, find_point, lasting_damage
from wheelleg_exp.jobs.resume.recomputed import Proof
from wheelleg_exp.jobs.threads import thread_notes
from wheelleg_exp.jobs.train import training
from wheelleg_exp.jobs.train.training import Training
from wheelleg_exp.packages import join_recorded, left_out, read_project
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.rl.ranks import ALONE, Ranks
from wheelleg_exp.rl.trainer import Trainer
from wheelleg_exp.run.begin import complete, refuse_secrets
from wheelleg_exp.run.directory import NEEDED, RunDirectory
from wheelleg_exp.run.lock import RunLock
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.process import is_alive, this_process
from wheelleg_exp.run.recorded import CONFIG
from wheelleg_exp.terms.allowed_targets import NotAllowed
from wheelleg_exp.verify.settings import decides


def prepare(
    run: RunDirectory,
    overrides: Sequence[str],
    command: Sequence[str],
    display: Display,
    config_dirs: Sequence[Path] = (),
    ranks: Ranks = ALONE,
) -> Training:
    """Bring a run back to its last whole checkpoint, ready for ``training.run``.

    The run's lock is taken here, and given back by ``training.run``.

    Args:
        run: the run.
        overrides: changes to its settings from here on.
        command: the command line, for the manifest.
        display: receives progress.
        config_dirs: the user's config folders; those that the run was made with where none are given.
        ranks: the processes that go on with it; the others do what ``follow`` says.

    Raises:
        WheellegError: the run is being written, is damaged or finished, or an override is wrong. Nothing of the run
            has changed then.
    """
    refuse_secrets(command, {"the overrides": "\n".join(overrides)})
    lock = RunLock(run)
    try:
        return _prepare(run, overrides, command, display, config_dirs, lock, ranks)
    except BaseException:
        lock.release()
        raise


def _prepare(
    run: RunDirectory,
    overrides: Sequence[str],
    command: Sequence[str],
    display: Display,
    config_dirs: Sequence[Path],
    lock: RunLock,
    ranks: Ranks,
) -> Training:
    with ranks.agreed():
        lock.acquire()
        manifest = run.manifest()
        _require_ended(manifest, display)
        manifest.settle()
        _require_snapshot(run, manifest)
        require_as_many(manifest, ranks)
        recorded = manifest.data.get("config_dirs") or _named(manifest)
        folders = join_recorded(config_dirs, recorded)
        others = left_out(recorded, folders)
        kept = kept_tree(run, manifest.data.get("config_variables") or {})
        with _telling_what_is_left_out(others):
            tree, changes = changed(kept, overrides)
        refuse_secrets((), {}, tree, kept)
        point = find_point(run)
        _require_work(manifest, point, int(tree["agent"]["max_iterations"]))
        texts = changed_texts(run, tree, changes, overrides)
        recipe = recipe_of(run, tree, texts.get(CONFIG) or read_text(run.path / CONFIG), folders)
    if ranks.together:
        tell_others(ranks, run, tree, recorded, point, learning_rate_of(changes))
    with _telling_what_is_left_out(others), ranks.agreed():
        trainer, threads = training.build(recipe, ranks)
    if not manifest.data["source"]:  # killed before the first step, while its source was being kept
        roots = [configs_dir().parent, *folders]
        complete(run, manifest, roots, threads, tree["run"].get("max_patch_mb"))
    with ranks.agreed():
        why = _loaded(run, trainer, point, changes)
    why += [reason for reasons in ranks.tell_all([])[1:] for reason in reasons]
    why += lasting_damage(run, manifest, point)
    differences = differences_now(run, threads, folders)
    why += [d.note or f"{d.section} {d.name} was {brief(d.a)} and is {brief(d.b)}" for d in differences]
    if not (engine := trainer.env.env.scene.sim.promise())["exact"]:
        why.append(f"the engine {engine['name']} on {engine['device']} does not repeat to the bit: {engine['because']}")
    exact = not why
    notes = [f"{path.name} cannot be used: {reason}" for path, reason in point.damaged.items()]
    manifest.restart(
        command=command,
        threads=threads,
        texts=texts,
        iteration=point.iteration,
        checkpoint=None if point.checkpoint is None else point.checkpoint.name,
        overrides=list(overrides),
        changes=[record(change) for change in changes],
        exact=exact,
        why=why,
        differences=[{"section": d.section, "name": d.name, "was": d.a, "now": d.b} for d in differences],
        notes=notes,
    )
    with manifest.failing():
        drop_past_checkpoint(run, point, events=tree["agent"].get("logger") is not None)
    _tell(display, point, why, [*notes, *thread_notes(threads)])
    proof = _proof(manifest, point, display) if exact else Proof()
    return Training(recipe, trainer, run, manifest, lock, point.kept, proof)


# --- what must be so ---


def _require_ended(manifest: Manifest, display: Display) -> None:
    """Refuse a run whose process lives; the lock tells that already where the file system knows locks."""
    process = manifest.data.get("process") or {}
    if manifest.status != "running":
        return
    alive = is_alive(process)
    if alive and process != this_process():
        raise RunDirectoryError(
            f"is still being written by process {process['pid']}",
            key=str(manifest.directory),
            expected="a run that has ended: wait for it, or end that process first",
        )
    if alive is None:
        display.note(
            f"note: the run's process {process.get('pid')} on {process.get('host')} cannot be seen from here; "
            "it is taken for dead"
        )


def _require_snapshot(run: RunDirectory, manifest: Manifest) -> None:
    """Refuse a snapshot that is not whole, or not what the run was started with."""
    recorded = manifest.data["files"]
    for name in NEEDED:
        path = run.path / name
        if not path.is_file():
            raise RunDirectoryError(
                "is missing: the run ended before its snapshot was whole, or the file was removed",
                key=str(path),
                expected="the snapshot that every run begins with; without it, train again",
            )
        if name in recorded and sha256(path) != recorded[name]["sha256"]:
            raise RunDirectoryError(
                "was changed since the run began",
                key=str(path),
                expected="the file as it was; settings change by overrides, 'wheelleg resume RUN key=value'",
            )


def _named(manifest: Manifest) -> list[str]:
    """Return the config folders that the command line names, for a run that was killed before they were recorded."""
    words = [str(word) for word in manifest.data.get("command") or ()]
    named = [after for word, after in pairwise(words) if word == "--config-dir"]
    named += [word.partition("=")[2] for word in words if word.startswith("--config-dir=")]
    place = Path(str(manifest.data.get("working_directory") or "."))
    projects = (read_project(folder) for folder in (place / name for name in named))
    return [str(project.configs if project else place / name) for project, name in zip(projects, named, strict=True)]


def _require_work(manifest: Manifest, point: ResumePoint, total: int) -> None:
    done = point.iteration
    if total < done or (total == done and manifest.status == "finished"):
        raise ConfigError(
            f"is {total}, and the run has done {done} iterations",
            key="agent.max_iterations",
            expected=f"more than {done}: 'wheelleg resume {manifest.directory.name} agent.max_iterations=N'",
        )


@contextmanager
def _telling_what_is_left_out(folders: Mapping[str, str]) -> Iterator[None]:
    """Let errors about targets that are not found name the recorded config folders that are not used, and why."""
    try:
        yield
    except ConfigError as error:
        errors = parts(error)
        for part in errors if folders else ():
            if isinstance(part, NotAllowed):
                for why in dict.fromkeys(folders.values()):
                    names = ", ".join(folder for folder, reason in folders.items() if reason == why)
                    part.message += f", and what the run was made with {why}: {names}"
                part.expected = "--config-dir with the place where that folder is now, if it is yours"
        raise join(errors) from error.__cause__


# --- loading ---


def _loaded(run: RunDirectory, trainer: Trainer, point: ResumePoint, changes: Sequence[Change]) -> list[str]:
    """Load the checkpoint; return why what follows is not exactly what would have followed."""
    deciding = [record(change) for change in changes if decides(change.keys)]
    if trainer.env.env.scene.model_digest() != kept_model_digest(run):
        raise RunDirectoryError(
            "the robot compiles to another model than the run's, so that its state means something else",
            key=str(run.asset),
            expected="the MuJoCo version that the run was made with (environment.txt)",
        )
    why = [f"{change['key']} was {brief(change['was'])} and is {brief(change['now'])}" for change in deciding]
    if point.state is None:
        return why
    lost = load(trainer, point.state, learning_rate_of(changes))
    return why if deciding else [*why, *lost]


# --- telling ---


def _proof(manifest: Manifest, point: ResumePoint, display: Display) -> Proof:
    def differs(iteration: int, names: list[str]) -> None:
        reason = f"iteration {iteration} is not what it was before the stop: {', '.join(names)} differ"
        display.note(f"warning: {reason}; some state of the run is in no checkpoint")
        manifest.amend_resume(exact=False, why=[reason])

    def holds(first: int, last: int) -> None:
        manifest.amend_resume(proved=[first, last])

    return Proof(point.dropped, differs, holds)


def _tell(display: Display, point: ResumePoint, why: Sequence[str], notes: Sequence[str]) -> None:
    for note in notes:
        display.note(note if note.startswith("warning") else f"note: {note}")
    where = "the beginning" if point.checkpoint is None else point.checkpoint.name
    display.note(f"resuming from {where}, iteration {point.iteration}")
    if point.dropped:
        display.note(f"{len(point.dropped)} later iterations are computed again and held against the log")
    if why:
        display.note("not exact: what follows may differ from a run that was never stopped")
        for reason in why:
            display.note(f"  {reason}")
