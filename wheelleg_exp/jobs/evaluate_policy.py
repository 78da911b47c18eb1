"""Evaluate policies or an LQR controller in fixed scenarios, compare evaluations, and save both in a run directory."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict

from wheelleg_exp.asset.conversion_cache import source_digest
from wheelleg_exp.build import with_robot_file
from wheelleg_exp.config.checking.find_mistakes import check_tree
from wheelleg_exp.config.composing.compose import apply_overrides, compose, placing, require_read
from wheelleg_exp.config.config_errors import raise_all
from wheelleg_exp.config.tree_lookup import section_at
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError, RunDirectoryError, SimulationFailure
from wheelleg_exp.evaluation import method_comparison as comparison
from wheelleg_exp.evaluation.evaluation_env import evaluation_options, target_heights
from wheelleg_exp.evaluation.lqr_balancer import Reference
from wheelleg_exp.evaluation.method_comparison import Difference, OverSeeds
from wheelleg_exp.evaluation.protocol import MakePolicy, Progress, evaluate
from wheelleg_exp.evaluation.protocol_options import EvaluateRoot, Protocol
from wheelleg_exp.evaluation.result import FORMAT, Evaluation, Figure, plain
from wheelleg_exp.files import for_people, read_json, sha256, write_json, write_text
from wheelleg_exp.jobs.rollout_files import checkpoint_facts, dated_folder
from wheelleg_exp.jobs.saved_robot import require_same_robot, saved_mjcf
from wheelleg_exp.jobs.torch_threads import set_threads
from wheelleg_exp.rl.network_loading import load_policy
from wheelleg_exp.rl.options import Learning
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.run import run_config
from wheelleg_exp.run.records import Addition
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.sim.options import engine_kind, read_env
from wheelleg_exp.terms.config_sections import plain_section, read_section
from wheelleg_exp.user_exceptions import ending_as

RESULT, EPISODES = "evaluation.json", "episodes.csv"
_EXPECTED = "an evaluation that wheelleg evaluate has written"


def write_episodes(path: Path, episodes: Mapping[str, np.ndarray]) -> None:
    """Write the evaluated episodes as CSV, one per row; Python's number format preserves every bit of a float."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(episodes)
    for row in zip(*(column.tolist() for column in episodes.values()), strict=True):
        # NaN becomes an empty cell, and a whole number is written without a decimal point.
        writer.writerow("" if x != x else int(x) if isinstance(x, float) and x.is_integer() else x for x in row)
    write_text(path, file.getvalue())


def read_content(folder: Path) -> dict[str, Any]:
    """Return the content of a saved ``evaluation.json``."""
    path = folder / RESULT
    content = read_json(path)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise RunDirectoryError(f"the file is not an evaluation in format {FORMAT}", key=str(path), expected=_EXPECTED)
    return content


def read_evaluation(folder: Path) -> Evaluation:
    """Load a saved evaluation and the episodes of this evaluation."""
    content = read_content(folder)
    try:
        metrics = {}
        for name, value in content["metrics"].items():
            numbers = (math.nan if value[key] is None else float(value[key]) for key in ("value", "low", "high"))
            found, low, high = numbers
            metrics[name] = Figure(found, low, high, value["episodes"], value["unit"], value["better"])
        facts = {key: content[key] for key in ("protocol", "seed", "scenarios_sha256", "starts_sha256", "about")}
        return Evaluation(episodes=read_episodes(folder / EPISODES), metrics=metrics, **facts)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise RunDirectoryError(f"the evaluation is damaged: {error!r}", key=str(folder), expected=_EXPECTED) from error


def read_episodes(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of ``episodes.csv``: texts, or numbers with NaN for empty cells."""
    with for_people(path, "read"):
        rows = list(csv.reader(io.StringIO(path.read_text(encoding="utf-8"))))
    if not rows:
        raise RunDirectoryError("the file is empty", key=str(path), expected=_EXPECTED)
    return {name: _column([row[i] for row in rows[1:]]) for i, name in enumerate(rows[0])}


# ``MARGINS`` maps the margins that reports and bundles show to their names and units.
MARGINS = {
    "robust/margin/delay": ("delay of the actions", "s"),
    "robust/margin/noise": ("noise of the sensors", "times noise_std"),
    "robust/margin/kick": ("kick forwards or backwards", "m/s"),
    "robust/margin/slope": ("slope of the floor", "rad"),
}


class Margin(NamedTuple):
    """The largest change of one property that a policy survives, and that of the reference controller if measured."""

    name: str
    unit: str
    policy: float
    reference: float | None


def margins_of(additions: Sequence[Addition], checkpoint_sha256: str | None = None) -> list[Margin]:
    """Return the margins of a run's newest evaluation that measured any, of a checkpoint if given; [] without one."""

    def margins(results: Mapping[str, object]) -> dict[str, float]:
        metrics = results.get("metrics")
        found = {name: metrics.get(name) for name in MARGINS} if isinstance(metrics, Mapping) else {}
        return {name: value for name, value in found.items() if isinstance(value, (int, float))}

    results = [(entry.kind, entry.results) for entry in additions if margins(entry.results)]
    sha, scenarios = "checkpoint_sha256", "scenarios_sha256"
    mine = [r for kind, r in results if kind == "evaluation" and checkpoint_sha256 in (None, r.get(sha))]
    if not mine:
        return []
    same = [r for kind, r in results if kind == Reference.name and r.get(scenarios) == mine[-1].get(scenarios)]
    reference = margins(same[-1]) if same else {}
    return [Margin(*MARGINS[name], value, reference.get(name)) for name, value in margins(mine[-1]).items()]


def _column(cells: Sequence[str]) -> np.ndarray:
    try:
        return np.array([float(cell) if cell else np.nan for cell in cells])
    except ValueError:
        return np.array(cells)


_ALTERNATIVES = {
    "env.num_envs": "the episodes of a test, such as protocol.stand.episodes",
    "env.episode_length_s": "the length of a test, such as protocol.stand.horizon_s",
    "env.scene.terrain": "protocol.ground=own, which evaluates on the task's own ground",
    "env.rewards": "a key that an evaluation reads: rewards are not computed",
    "agent.device": "env.sim.engine and env.sim.device: the policy runs where the simulation does",
    "agent": "agent.torch_threads, agent.clip_actions, or a key of the policy's network",
    "": "a key of what is evaluated: robot, scene, actions, observations, failures, events at startup and reset",
}


def evaluation_settings(
    run: RunDirectory, overrides: Sequence[str], config_dirs: Sequence[Path] = ()
) -> tuple[EvaluateRoot, dict[str, object]]:
    """Return the config of an evaluation, and its section ``protocol`` as plain data, which results contain.

    Overrides of other keys than ``protocol`` and ``seed`` change the run's config.
    """
    mine = [text for text in overrides if _is_of_protocol(text)]
    others = run_overrides(overrides)
    composed = compose(mine, primary="evaluate", config_dirs=config_dirs)
    env, agent = run_config.load_params(run)
    recorded = {"env": run_config.on_reference_engine(run_config.upgrade_env_params(env)), "agent": agent}
    tree = {**apply_overrides(recorded, others), **{key: composed.config[key] for key in ("seed", "protocol")}}
    with composed.placing(), placing(others):
        if errors := check_tree(tree, EvaluateRoot):
            raise_all(errors)
        require_same_robot(recorded, tree, "a policy is evaluated on the robot that it was trained on")
        config = read_section(EvaluateRoot, tree, "")
        require_read(recorded, others, lambda changed: _settings_read(changed, config.protocol), _ALTERNATIVES)
        config = replace(config, env=with_robot_file(config.env, composed.asset_roots))
        if engine_kind(config.env.sim.engine).reads_robot_file:
            saved, present = run_config.recorded_robot(run).sources, source_digest(Path(config.env.robot.asset))
            if changed := [name for name, digest in present.items() if saved.get(name) != digest]:
                message = f"{changed[0]} differs from the file that the run was trained with"
                raise ConfigError(message, key="env.robot.asset", expected="the run's robot, or env.sim.engine=mujoco")
    return config, tree["protocol"]


def _settings_read(tree: Mapping[str, object], protocol: Protocol) -> Mapping[str, object]:
    """Return the parts of the config sections ``env`` and ``agent`` that an evaluation uses."""
    env = read_env(section_at(tree, "env"))
    agent = {key: value for key, value in section_at(tree, "agent").items() if key in run_config.POLICY_KEYS}
    used = plain_section(evaluation_options(env, protocol, 0, 0.0, protocol.ground))
    rewards = {} if protocol.target_height is not None else target_heights(env)
    return {"env": {**used, "rewards": rewards}, "agent": agent}


def run_overrides(overrides: Sequence[str]) -> list[str]:
    """Return an evaluation's overrides without those of ``protocol`` and ``seed``, such as ``seed=3``."""
    return [text for text in overrides if not _is_of_protocol(text)]


def _is_of_protocol(override: str) -> bool:
    key = override.lstrip("+~").partition("=")[0]
    return key.split(".")[0].split("@")[0] in ("protocol", "seed")


# ``Draw`` is a function that writes plots of an evaluation into a folder and returns the paths of the plots.
Draw = Callable[[Evaluation, Path], list[Path]]


@dataclass(frozen=True)
class Evaluated:
    """The result of an evaluation, as saved in ``evaluation.json``; ``checkpoint`` is None for an LQR controller."""

    run: RunDirectory
    checkpoint: Path | None
    folder: Path
    evaluation: Evaluation
    content: dict[str, Any]


def evaluate_run(
    run: RunDirectory,
    checkpoint: Path | None,
    overrides: Sequence[str],
    command: Sequence[str],
    progress: Progress | None = None,
    config_dirs: Sequence[Path] = (),
    draw: Draw | None = None,
    *,
    reference: bool = False,
) -> Evaluated:
    """Evaluate the mean action of a checkpoint (default: the last), and save the result in the run directory.

    With ``reference``, evaluate an LQR controller instead; ConfigError means that it cannot balance the robot.
    ``progress`` is called with the name of the current test, the finished steps, and the total steps of this test.
    """
    if checkpoint is None and not reference:
        checkpoint = run.latest_checkpoint()
    config, protocol = evaluation_settings(run, overrides, config_dirs)
    controllers: list[Reference] = []

    def make_controller(env: ManagerBasedRLEnv) -> Reference:
        controllers.append(Reference(env, config.protocol.command))
        return controllers[-1]

    make = make_controller if checkpoint is None else policy_of(checkpoint, config.agent)
    with ending_as(SimulationFailure):
        found = evaluate(config.env, saved_mjcf(run), make, protocol, config.seed, progress=progress)
    content: dict[str, Any] = {"policy": Reference.name, **controllers[0].describe()} if checkpoint is None else {}
    content |= {} if checkpoint is None else checkpoint_facts(run, checkpoint)
    content |= {"overrides": list(overrides), **found.as_dict()}
    with dated_folder(run.evaluation) as folder:
        write_episodes(folder / EPISODES, found.episodes)
        write_json(folder / RESULT, content)
        files = [folder / RESULT, folder / EPISODES, *([] if draw is None else draw(found, folder))]
        keys = ("checkpoint", "checkpoint_sha256", "seed", "scenarios_sha256", "starts_sha256")
        results = {"protocol": found.protocol["name"], **{key: content[key] for key in keys if key in content}}
        results["metrics"] = {name: figure.as_dict()["value"] for name, figure in found.metrics.items()}
        run.manifest().add(Reference.name if checkpoint is None else "evaluation", files, results, command=command)
    return Evaluated(run, checkpoint, folder, found, content)


def policy_of(checkpoint: Path, agent: Learning) -> MakePolicy:
    """Return a function that loads a checkpoint's policy for an environment; the policy gives clipped mean actions."""

    def make(env: ManagerBasedRLEnv) -> Callable[[Mapping[str, object]], torch.Tensor]:
        set_threads(agent, env.scene.sim.nthread)
        clip = agent.clip_actions
        policy = load_policy(checkpoint, RslRlVecEnv(env, clip), agent)
        policy.to(env.device)

        def act(observations: Mapping[str, object]) -> torch.Tensor:
            actions: torch.Tensor = policy(TensorDict(dict(observations), batch_size=[env.num_envs]))
            return actions if clip is None else actions.clamp(-clip, clip)

        return act

    return make


def stored_evaluation(
    run: RunDirectory, checkpoint: Path, overrides: Sequence[str], config_dirs: Sequence[Path] = ()
) -> Evaluated | None:
    """Load the newest evaluation of a checkpoint with equal settings from the run directory, or return None."""
    config, protocol = evaluation_settings(run, overrides, config_dirs)
    asked = (sha256(checkpoint), config.seed, protocol, run_overrides(overrides))
    folders = [path.parent for path in run.evaluation.glob(f"*/{RESULT}")] if run.evaluation.is_dir() else []
    for folder in sorted(folders, reverse=True):
        content = read_content(folder)
        made = tuple(content.get(key) for key in ("checkpoint_sha256", "seed", "protocol"))
        if (*made, run_overrides(content.get("overrides") or [])) == asked:
            return Evaluated(run, checkpoint, folder, read_evaluation(folder), content)
    return None


COMPARISON = "comparison.json"
COMPARISON_FORMAT = 1


@dataclass(frozen=True)
class Compared:
    """The result of a comparison of runs: each metric over all runs, and differences from a second group of runs."""

    folder: Path
    seeds: list[OverSeeds]
    differences: list[Difference]  # empty without ``against``
    verdict: str  # empty without ``against``
    push_verdict: str
    content: dict[str, Any]  # the content of ``comparison.json``


def compare(
    runs: Sequence[Evaluated],
    against: Sequence[Evaluated],
    reference: Evaluated | None,
    command: Sequence[str],
    name: str | None = None,
    engines: Sequence[str] = (),
) -> Compared:
    """Compare the evaluations of runs, and save the comparison in the directory of the first run.

    ``runs`` and ``against`` are runs of two training methods with different seeds. ``name`` is the common name of
    ``runs``, by default the id of the first run. ``engines`` names two engines with which the same runs were evaluated.
    """
    seeds = comparison.over_seeds([made.evaluation for made in runs])
    found = comparison.differences([m.evaluation for m in runs], [m.evaluation for m in against]) if against else []
    names = name or group_name(runs), group_name(against) if against else ""
    # ``trainings`` counts the training runs of each method; an LQR controller has no training runs.
    trainings = [len(side) for side in (runs, against) if side and side[0].checkpoint is not None]
    if engines:
        said, pushed = comparison.engine_verdict(found, *engines), ""
        abouts = [made.evaluation.about for made in (*runs, *against)]
        if odd := dict.fromkeys(text for about in abouts for text in about.get("robot_differences", ())):
            said += f" The robot differs between {' and '.join(engines)}: {', '.join(odd)}."
    else:
        said = comparison.verdict(found, *names, trainings) if against else ""
        pushed = comparison.push_verdict(found, *names)
    evaluation = runs[0].evaluation
    content = {
        "format": COMPARISON_FORMAT,
        "protocol": evaluation.protocol["name"],
        "scenarios_sha256": evaluation.scenarios_sha256,
        "runs": [_identify(made) for made in runs],
        "against": [_identify(made) for made in against],
        "reference": None if reference is None else _identify(reference),
        "over_seeds": {row.metric: plain(asdict(row)) for row in seeds},
        "differences": {row.metric: row.as_dict() for row in found},
        "verdict": said,
        "push_verdict": pushed,
    }
    run = runs[0].run
    with dated_folder(run.evaluation, "_comparison") as folder:
        write_json(folder / COMPARISON, content)
        results = {"protocol": content["protocol"], "verdict": said, "push_verdict": pushed}
        if engines:
            values = {row.metric: [row.first, row.second, row.unit] for row in comparison.judged_metrics(found)}
            results |= {"engines": list(engines), "metrics": plain(values), "runs": len(runs)}
        run.manifest().add("comparison", [folder / COMPARISON], results, command=command)
    return Compared(folder, seeds, found, said, pushed, content)


def group_name(made: Sequence[Evaluated]) -> str:
    """Return a name for a group of evaluated runs, for use in a sentence."""
    names = [display_name(one) for one in made]
    return names[0] if len(names) == 1 else f"{names[0]} with {len(names) - 1} more of its kind"


def display_name(made: Evaluated) -> str:
    """Return the name of an evaluation in a table: the id of the run, or the name of the reference controller."""
    return made.run.id if made.checkpoint is not None else f"the {made.content['policy']} controller"


def _identify(made: Evaluated) -> dict[str, object]:
    about = {"run": made.run.id, "evaluation": made.folder.name, "starts_sha256": dict(made.evaluation.starts_sha256)}
    if made.checkpoint is None:
        return about | {"policy": made.content["policy"]}
    return about | {"checkpoint_sha256": made.content["checkpoint_sha256"]}
