"""Resume a stopped, killed, or extended training run; the resumed run is bitwise equal to an uninterrupted run."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf

from wheelleg_exp.config import schema
from wheelleg_exp.config.checking.find_mistakes import check_tree
from wheelleg_exp.config.composing.compose import apply_overrides, placing
from wheelleg_exp.config.config_errors import join, parts, raise_all
from wheelleg_exp.config.explaining.config_diff import ABSENT, Change, changes
from wheelleg_exp.config.tree_lookup import at, section_at
from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.files import cut, for_people, read_text, sha256, temporaries
from wheelleg_exp.jobs.job_display import Display
from wheelleg_exp.jobs.rollout_files import dataset_files_from
from wheelleg_exp.jobs.saved_robot import load_saved_robot
from wheelleg_exp.jobs.torch_threads import thread_notes
from wheelleg_exp.jobs.train.prepare_training import Recipe, Training, build_trainer
from wheelleg_exp.jobs.train.source_roots import differences_now, shorten
from wheelleg_exp.jobs.train.training_outputs import cut_events
from wheelleg_exp.jobs.train.training_recording import films_from
from wheelleg_exp.packages import join_recorded, left_out, read_project
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.plain_data import dump_yaml
from wheelleg_exp.rl import checkpoint, digests, policy_average
from wheelleg_exp.rl.options import Learning
from wheelleg_exp.rl.ranks import ALONE, Ranks, state_of_rank
from wheelleg_exp.rl.trainer import Trainer
from wheelleg_exp.run import run_config
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.iteration_log import IterationLog, Line, LogLine, comparable_digests, read_log
from wheelleg_exp.run.manifest import SNAPSHOT, Manifest
from wheelleg_exp.run.run_config import CONFIG, recorded_robot
from wheelleg_exp.run.run_directory import CHECKPOINT, FAILURE, NEEDED, RunDirectory, checkpoint_iteration
from wheelleg_exp.run.run_list import effective_status
from wheelleg_exp.run.run_lock import ProcessId, RunLock, is_alive, this_process
from wheelleg_exp.run.start_run import complete_snapshot
from wheelleg_exp.terms.key_syntax import Keys
from wheelleg_exp.terms.term_binding import RESERVED, NotAllowed
from wheelleg_exp.verify.check_files import Subject, damage
from wheelleg_exp.verify.run_differences import decides

_CONTINUED_FILES = ("iterations.jsonl", "recording.rrd")
_DAMAGED = ".damaged"


@dataclass(frozen=True)
class ResumePoint:
    """The point from which a run resumes: the end of the last iteration that has a complete checkpoint."""

    iteration: int  # the first training iteration that the resume computes
    checkpoint: Path | None  # the checkpoint from which the run resumes; None if the run restarts at iteration 0
    state: Mapping[str, object] | None
    lines: Sequence[Line]  # the complete lines in the run's iteration log
    damaged: Mapping[Path, str]  # maps each damaged checkpoint after ``iteration`` to a text about the damage

    @property
    def earlier_lines(self) -> list[LogLine]:
        """The lines in the run's iteration log up to the checkpoint."""
        return [line.content for line in self.lines[: self.iteration]]

    def dropped(self, until: int) -> dict[int, Mapping[str, str]]:
        """Return the logged digests (hashes) of the iterations, up to ``until - 1``, that the resume repeats."""
        later = self.lines[self.iteration : until]
        return {line.iteration: found for line in later if (found := comparable_digests(line, digests.FORMAT))}


def find_point(run: RunDirectory) -> ResumePoint:
    """Find the last checkpoint of a run whose digests (hashes) equal those in the iteration log.

    RunDirectoryError means that no checkpoint matches the log, or that the checkpoint's format is too old.
    """
    lines = read_log(run.iterations).lines
    damaged: dict[Path, str] = {}
    foreign: RunDirectoryError | None = None
    for path in reversed(run.checkpoints()):
        try:
            state = checkpoint.load(path, finite=False)  # Accept a checkpoint with NaN; the training detects NaN.
            if state["iter"] != checkpoint_iteration(path):
                message = f"the checkpoint's iteration {state['iter']} differs from its file name"
                raise RunDirectoryError(message, key=str(path))
        except RunDirectoryError as error:
            damaged[path] = error.message
            continue
        checkpoint.require_resumable(state)
        point = ResumePoint(checkpoint_iteration(path) + 1, path, state, lines, damaged)
        if len(point.lines) < point.iteration:
            raise RunDirectoryError(
                f"{run.iterations.name} has no complete line of iteration {len(point.lines)}, but the checkpoint "
                f"{path.name} exists",
                key=str(run.iterations),
                expected=f"a line for each iteration up to {point.iteration - 1}; or no checkpoint from "
                f"model_{len(point.lines)}.pt on, to resume from an earlier one",
            )
        logged = comparable_digests(lines[point.iteration - 1], digests.format_of(state))
        stored = digests.of_state(state) if logged else {}
        wrong = [name for name, digest in logged.items() if stored.get(name, digest) != digest]
        if not wrong:
            return point
        verb = "differ" if len(wrong) > 1 or wrong[0].endswith("s") else "differs"
        damaged[path] = f"{', '.join(wrong)} {verb} from the logged digests of iteration {point.iteration - 1}"
        why = f"no checkpoint belongs to the training in {run.iterations.name}: {damaged[path]}"
        own = "the run's own checkpoints and log"
        foreign = foreign or RunDirectoryError(why, key=str(path), expected=own)
    if foreign is not None:  # A restart at iteration 0 would discard the finished training iterations.
        raise foreign
    return ResumePoint(0, None, None, lines, damaged)


def lasting_damage(run: RunDirectory, manifest: Manifest, point: ResumePoint) -> list[str]:
    """Return texts about damaged files of a run that a resume will not replace."""
    found = []
    for name, what in damage(Subject(run, manifest, effective_status(manifest), IterationLog())).items():
        saved, is_continued = CHECKPOINT.fullmatch(name), point.iteration > 0 and name in _CONTINUED_FILES
        lasts = int(saved[1]) < point.iteration if saved else name == MANIFEST_NAME or name.startswith(SNAPSHOT)
        found += [f"{name} {what}"] if lasts or is_continued else []
    return found


def drop_past_checkpoint(run: RunDirectory, point: ResumePoint, *, events: bool) -> None:
    """Remove data after the checkpoint and of killed processes; ``events`` also cuts TensorBoard's event files."""
    for path in point.damaged:
        with for_people(path):
            path.replace(path.with_name(path.name + _DAMAGED))
    with for_people(run.path):
        for folder in (run.hydra, run.params, run.source, run.asset, run.videos, run.dataset):
            _remove(temporaries(folder, deep=True))
        _remove(temporaries(run.path))
        _remove(films_from(run.videos, point.iteration))
        _remove(dataset_files_from(run.dataset, point.iteration))
        # Delete exported files such as ``policy.pt``, because they do not name the checkpoint of their policy.
        for path in run.exported.iterdir() if run.exported.is_dir() else ():
            if path.is_file():
                path.unlink()
            elif path in temporaries(run.exported):  # A killed export process can leave a temporary folder.
                shutil.rmtree(path)
        (run.path / FAILURE).unlink(missing_ok=True)  # Delete the simulation state that an earlier failure saved.
        if point.iteration == 0:
            run.recording.unlink(missing_ok=True)
    cut(run.iterations, point.lines[point.iteration - 1].end if point.iteration else 0)
    if events:
        cut_events(run.path, point.earlier_lines)


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        path.unlink(missing_ok=True)


def resume_recipe(run: RunDirectory, tree: dict[str, object], text: str, folders: Sequence[Path]) -> Recipe:
    """Return the inputs of a resumed training, with the robot that the run directory contains."""
    matmul = (run.manifest().data.get("threads") or {}).get("matmul")
    return Recipe(tree, {"config.yaml": text}, (), load_saved_robot(run), folders, matmul=matmul)


def load_state(trainer: Trainer, state: Mapping[str, object], learning_rate: float | None) -> list[str]:
    """Load this rank's part of a checkpoint; return texts about state that could not be restored exactly."""
    own = state_of_rank(state, trainer.ranks.rank)
    trainer.load_state_dict(own)
    if learning_rate is not None:
        trainer.set_learning_rate(learning_rate)
    wanted = digests.of_state(own if trainer.average.is_on else policy_average.without_average(own))
    found = digests.of_state(trainer.state_dict())
    layout_differs = digests.format_of(own) != digests.FORMAT
    lost = [n for n in wanted if wanted[n] != found.get(n) and not (layout_differs and n == "environment")]
    return [f"after loading, {', '.join(lost)} differ from the saved state"] if lost else []


def learning_rate_of(changes: Sequence[Change]) -> float | None:
    """Return the learning rate that the overrides of a resume set; None if no override sets a learning rate."""
    found = [change.b for change in changes if change.keys == ("agent", "algorithm", "learning_rate")]
    return float(found[-1]) if found else None


def require_same_world_size(manifest: Manifest, ranks: Ranks) -> None:
    """Raise an error if the number of ranks changed, because each rank has its own environments and random numbers."""
    trained = int((manifest.data.get("ranks") or {}).get("world_size", 1))
    if trained == ranks.size:
        return
    command = f"wheelleg resume {manifest.directory.name}"
    raise RunDirectoryError(
        f"the run was trained by {_processes(trained)} and cannot resume with {_processes(ranks.size)}: each process "
        "has its own environments and random numbers",
        key=str(manifest.directory),
        expected=f"torchrun --nproc-per-node {trained} --no-python {command}" if trained > 1 else f"'{command}' alone",
    )


def prepare_other_rank(ranks: Ranks, config_dirs: Sequence[Path]) -> tuple[Trainer, Learning]:
    """Prepare the resume of a run in a rank above 0; return the trainer and the options of the agent."""
    with ranks.agreed():
        pass  # The ranks above 0 wait while rank 0 reads the run directory.
    message = ranks.from_first(None)
    run = RunDirectory(Path(message["run"]))
    with ranks.agreed():
        recipe = resume_recipe(run, message["tree"], "", join_recorded(config_dirs, message["recorded"]))
        trainer, _ = build_trainer(recipe, ranks)
    why: list[str] = []
    with ranks.agreed():
        if message["checkpoint"] is not None:
            state = checkpoint.load(Path(message["checkpoint"]), finite=False)
            why = load_state(trainer, state, message["learning_rate"])
    ranks.gather_all([f"in process {ranks.rank}, {reason}" for reason in why])
    return trainer, recipe.experiment.agent


def _processes(count: int) -> str:
    return "one process" if count == 1 else f"{count} processes"


def prepare_resume(
    run: RunDirectory,
    overrides: Sequence[str],
    command: Sequence[str],
    display: Display,
    config_dirs: Sequence[Path] = (),
    ranks: Ranks = ALONE,
) -> Training:
    """Lock a run and restore its last complete checkpoint; ``run_training.run`` continues and then unlocks the run.

    ``overrides`` change settings of later iterations. Empty ``config_dirs`` mean those in the manifest. WheellegError
    means a locked, damaged, or finished run, or a wrong override; all files remain unchanged.
    """
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
    # 1. Check the run, and apply the overrides of the resume.
    with ranks.agreed():
        lock.acquire()
        manifest = run.manifest()
        _require_ended(manifest, display)
        manifest.write_pending()
        _require_snapshot(run, manifest)
        require_same_world_size(manifest, ranks)
        recorded = manifest.data.get("config_dirs") or _config_dirs_of_command(manifest)
        folders = join_recorded(config_dirs, recorded)
        unused = left_out(recorded, folders)
        recorded_config = recorded_tree(run, manifest.data.get("config_variables") or {})
        with _naming_unused_folders(unused):
            tree, changes = change_settings(recorded_config, overrides)
        point = find_point(run)
        texts = rewritten_files(run, tree, changes, overrides)
        recipe = resume_recipe(run, tree, texts.get(CONFIG) or read_text(run.path / CONFIG), folders)
        agent = recipe.experiment.agent
        _require_work(manifest, point, agent.max_iterations)
    # 2. Build the environment and the networks in every rank.
    if ranks.together:
        ranks.from_first(
            {
                "run": str(run.path),
                "tree": tree,
                "recorded": [str(folder) for folder in recorded],
                "checkpoint": None if point.checkpoint is None else str(point.checkpoint),
                "learning_rate": learning_rate_of(changes),
            }
        )
    with _naming_unused_folders(unused), ranks.agreed():
        trainer, threads = build_trainer(recipe, ranks)
    if not manifest.data["source"]:  # If the run was killed before its source code was recorded, record the code now.
        complete_snapshot(run, manifest, [configs_dir().parent, *folders], threads, recipe.experiment.run.max_patch_mb)
    # 3. Load the checkpoint, and collect the reasons why the resumed run may be inexact.
    with ranks.agreed():
        why = _load(run, trainer, point, changes)
    why += [reason for reasons in ranks.gather_all([])[1:] for reason in reasons]
    why += lasting_damage(run, manifest, point)
    differences = differences_now(run, threads, folders)
    why += [d.note or f"{d.section} {d.name} was {shorten(d.a)} and is {shorten(d.b)}" for d in differences]
    if not (engine := trainer.env.env.scene.sim.promise())["exact"]:
        why.append(f"the engine {engine['name']} on {engine['device']} does not repeat to the bit: {engine['because']}")
    # 4. Record the resume in the manifest, and remove data after the checkpoint from the run's files.
    exact = not why
    notes = [f"{path.name} cannot be used: {reason}" for path, reason in point.damaged.items()]
    manifest.restart(
        command=command,
        threads=threads,
        texts=texts,
        iteration=point.iteration,
        checkpoint=None if point.checkpoint is None else point.checkpoint.name,
        overrides=list(overrides),
        changes=[change_entry(change) for change in changes],
        exact=exact,
        why=why,
        differences=[{"section": d.section, "name": d.name, "was": d.a, "now": d.b} for d in differences],
        notes=notes,
    )
    with manifest.failing():
        drop_past_checkpoint(run, point, events=agent.logger is not None)
    dropped = point.dropped(agent.max_iterations)
    _report(display, point, len(dropped), why, [*notes, *thread_notes(threads)])
    recomputed = RecomputedCheck(dropped if exact else {}, manifest, display)
    return Training(recipe, trainer, run, manifest, lock, point.earlier_lines, recomputed)


def _require_ended(manifest: Manifest, display: Display) -> None:
    """Check that the run's process has ended, because locks do not work on every file system."""
    process = manifest.facts.process or ProcessId()
    if manifest.status != "running":
        return
    alive = is_alive(process)
    if alive and process != this_process():
        message = f"the run is still being written by process {process['pid']}"
        expected = "a run that has ended: wait for it, or end that process first"
        raise RunDirectoryError(message, key=str(manifest.directory), expected=expected)
    if alive is None:
        text = f"note: the run's process {process.get('pid')} on {process.get('host')} cannot be seen from here; "
        display.note(text + "it is treated as dead")


def _require_snapshot(run: RunDirectory, manifest: Manifest) -> None:
    recorded = manifest.data["files"]
    for name in NEEDED:
        path = run.path / name
        if not path.is_file():
            message = "the file is missing: the run ended before its snapshot was complete, "
            message += "or somebody removed the file"
            raise RunDirectoryError(message, key=str(path), expected="the snapshot of the run; without it, train again")
        if name in recorded and sha256(path) != recorded[name]["sha256"]:
            expected = "the unchanged file; overrides change settings, 'wheelleg resume RUN key=value'"
            raise RunDirectoryError("a run's file was changed after the run started", key=str(path), expected=expected)


def _config_dirs_of_command(manifest: Manifest) -> list[str]:
    """Return the config folders that the run's command line names with ``--config-dir``."""
    words = [str(word) for word in manifest.data.get("command") or ()]
    named = [after for word, after in pairwise(words) if word == "--config-dir"]
    named += [word.partition("=")[2] for word in words if word.startswith("--config-dir=")]
    place = Path(str(manifest.data.get("working_directory") or "."))
    projects = (read_project(folder) for folder in (place / name for name in named))
    return [str(project.configs if project else place / name) for project, name in zip(projects, named, strict=True)]


def _require_work(manifest: Manifest, point: ResumePoint, total: int) -> None:
    done = point.iteration
    if total < done or (total == done and manifest.status == "finished"):
        message = f"the number is {total}, and the run has done {done} iterations"
        expected = f"more than {done}: 'wheelleg resume {manifest.directory} agent.max_iterations=N'"
        raise ConfigError(message, key="agent.max_iterations", expected=expected)


@contextmanager
def _naming_unused_folders(folders: Mapping[str, str]) -> Iterator[None]:
    """If the config names a forbidden function, add the config folders that this resume ignores to the error."""
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


def _load(run: RunDirectory, trainer: Trainer, point: ResumePoint, changes: Sequence[Change]) -> list[str]:
    """Load the run's checkpoint; return the reasons why the resumed run may differ from an uninterrupted run."""
    deciding = [change_entry(change) for change in changes if decides(change.keys)]
    if trainer.env.env.scene.model_digest() != recorded_robot(run).model_sha256:
        message = "the robot compiles to another model than the run's, which does not fit its state"
        expected = "the MuJoCo version that the run was made with (environment.txt)"
        raise RunDirectoryError(message, key=str(run.asset), expected=expected)
    why = [f"{change['key']} was {shorten(change['was'])} and is {shorten(change['now'])}" for change in deciding]
    if point.state is None:
        return why
    lost = load_state(trainer, point.state, learning_rate_of(changes))
    return why if deciding else [*why, *lost]


class RecomputedCheck:
    """Compares the digests (hashes) of recomputed iterations with the digests that the run logged before the stop."""

    def __init__(self, expected: Mapping[int, Mapping[str, str]], manifest: Manifest, display: Display) -> None:
        self._expected, self._manifest, self._display = dict(expected), manifest, display
        self._range = [min(expected, default=0), max(expected, default=-1)]

    def __call__(self, iteration: int, found: Mapping[str, str]) -> None:
        """Compare the hashes of an iteration's training state with the logged hashes; record the first difference."""
        expected = self._expected.pop(iteration, None)
        if expected is None:
            return
        names = sorted(name for name in expected.keys() & found.keys() if expected[name] != found[name])
        if names:
            self._expected.clear()
            reason = f"iteration {iteration} differs from the iteration before the stop: {', '.join(names)} differ"
            self._display.note(f"warning: {reason}; the checkpoint lacks some state of the run")
            self._manifest.amend_resume(exact=False, why=[reason])
        elif iteration == self._range[1]:
            self._manifest.amend_resume(proved=self._range)


def _report(display: Display, point: ResumePoint, repeated: int, why: Sequence[str], notes: Sequence[str]) -> None:
    for note in notes:
        display.note(note if note.startswith("warning") else f"note: {note}")
    where = "the start" if point.checkpoint is None else point.checkpoint.name
    display.note(f"resuming from {where}, iteration {point.iteration}")
    if repeated:
        display.note(f"{repeated} later iterations are computed again and compared with the log")
    if why:
        display.note("not exact: the numbers may differ from a run that never stopped")
        for reason in why:
            display.note(f"  {reason}")


_SHAPE = "the checkpoint holds networks of this shape"
# ``_FIXED`` maps each setting that a resume cannot change to the reason.
_FIXED: dict[Keys, str] = {
    ("seed",): "the random streams continue from their saved state",
    ("task",): "the run belongs to its task",
    **dict.fromkeys((("init_from",), ("init_from_what",)), "the run started with these networks"),
    ("run",): "the run directory exists already",
    ("env", "num_envs"): "the saved state has a row for each environment",
    ("env", "decimation"): "all saved times count in its steps",
    **dict.fromkeys((("env", "sim"), ("env", "scene")), "it is part of the simulated model"),
    ("env", "robot"): "the saved state is that of the run's robot",
    ("env", "realism"): "the saved state is that of robots with these errors",
    ("env", "actions"): "the networks were trained with these actions",
    **{("agent", key): _SHAPE for key in ("actor", "critic", "student", "teacher", "obs_groups")},
    ("agent", "teacher_checkpoint"): "the run learns from one teacher",
    ("agent", "algorithm", "class_name"): "the checkpoint holds this algorithm's state",
    ("agent", "algorithm", "optimizer"): "the checkpoint holds this optimiser's state",
    ("agent", "algorithm", "rnd_cfg"): _SHAPE,
}
_CHANGEABLE = (("env", "sim", "graph_step"),)  # A resume can switch CUDA graphs (``env.sim.graph_step``) on or off.
_NEW_KEYS = ("init_from", "init_from_what")  # Configs of old runs lack ``init_from`` and ``init_from_what``.
_OBSERVATION_CHANGEABLE = ("noise", "clip", "scale", "enable_corruption")


def recorded_tree(run: RunDirectory, variables: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return the composed config of a run from the run's snapshot."""
    env, agent = run_config.load_params(run)
    tree = run_config.recorded_config(run, variables or {})
    for key, kind in (("seed", int), ("task", dict), ("recording", dict), ("run", dict)):
        if not isinstance(tree[key], kind):
            message = f"'{key}' is missing or wrong"
            raise RunDirectoryError(message, key=str(run.path / run_config.CONFIG), expected="the config of the run")
    earlier = {key: value for key, value in tree.items() if value is not None or key not in _NEW_KEYS}
    return {**earlier, "env": run_config.upgrade_env_params(env), "agent": agent}


def change_settings(recorded: Mapping[str, object], overrides: Sequence[str]) -> tuple[dict[str, Any], list[Change]]:
    """Apply the overrides of a resume; return the new config and its changes, or raise ConfigError for a fixed key."""
    tree = apply_overrides(recorded, overrides)
    run_config.require_resolved({part: tree.get(part) for part in run_config.PARTS})
    found = list(changes(recorded, tree, lambda was, now: type(was) is type(now) and bool(was == now)))
    with placing(overrides):
        for change in found:
            _require_changeable(change, recorded, tree)
        errors = check_tree(tree, schema.Experiment)
        if errors:
            raise_all(errors)
    return tree, found


def change_entry(change: Change) -> dict[str, object]:
    """Return a config change for the manifest; a missing key has the value None."""
    was, now = (None if value is ABSENT else value for value in (change.a, change.b))
    return {"key": change.key, "was": was, "now": now}


def _require_changeable(change: Change, recorded: Mapping[str, object], tree: Mapping[str, object]) -> None:
    if not decides(change.keys) or change.keys in _CHANGEABLE:
        return
    for prefix, why in _FIXED.items():
        if change.keys[: len(prefix)] == prefix or prefix[: len(change.keys)] == change.keys:
            raise _refusal(change, why)
    if change.keys[:2] == ("env", "observations") and not set(change.keys[3:]) & set(_OBSERVATION_CHANGEABLE):
        raise _refusal(change, "the networks were trained with this observation")
    section = change.keys[1] if change.keys[0] == "env" and len(change.keys) > 1 else ""
    if section in RESERVED and section != "observations":
        now = at(tree, ("env", section))
        if not isinstance(now, Mapping) or list(now) != list(section_at(recorded, ("env", section))):
            why = "the saved state has a place for each term of the run; a weight of 0 turns a reward off"
            raise _refusal(change, why)
        if change.keys[3:] in ((), ("_target_",), ("mode",)):
            raise _refusal(change, "the saved state is that of the run's own terms")


def _refusal(change: Change, why: str) -> ConfigError:
    message = f"cannot change in a resume: {why}"
    other = "a new run can have another value and, with init_from=RUN, start from this run's networks if they fit"
    return ConfigError(message, key=change.key, expected=f"the run's own value; {other}")


def rewritten_files(
    run: RunDirectory, tree: Mapping[str, object], found: Sequence[Change], overrides: Sequence[str]
) -> dict[str, str]:
    """Return the run's config files with the changed settings as ``{path: text}``, or {} without a change."""
    if not found:
        return {}
    config = run_config.load_config(run)
    for change in found:
        _apply(config, change, tree)
    # The overrides of a resume replace overrides of the run with the same keys.
    words = {_key(word): word for word in (*run_config.recorded_overrides(run), *overrides)}
    return {
        "params/env.yaml": dump_yaml(tree["env"]),
        "params/agent.yaml": dump_yaml(tree["agent"]),
        run_config.CONFIG: OmegaConf.to_yaml(OmegaConf.create(config)),
        run_config.OVERRIDES: OmegaConf.to_yaml(OmegaConf.create(list(words.values()))),
    }


def _apply(config: dict[str, object], change: Change, tree: Mapping[str, object]) -> None:
    """Change a key in the run's config; if an interpolation stands for a parent of the key, resolve it first."""
    node: Any = config
    for key in change.keys[:-1]:
        tree = section_at(tree, (key,))
        if isinstance(node.get(key), str):
            node[key] = copy.deepcopy(dict(tree))
        elif node.get(key) is None:
            node[key] = {}
        node = node[key]
    if change.b is ABSENT:
        node.pop(change.keys[-1], None)
    else:
        node[change.keys[-1]] = change.b


def _key(word: str) -> str:
    try:
        override = OverridesParser.create().parse_override(word)
    except (HydraException, RecursionError):  # If Hydra cannot parse an override, its whole text is the key.
        return word
    return f"{override.key_or_group}@{override.package or ''}"
