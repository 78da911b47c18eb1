"""Import a folder: write a project with robot, task, and agent, and a run directory with the policy."""

from __future__ import annotations

import shutil
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from wheelleg_exp import packages as projects
from wheelleg_exp.asset.convert_robot import read
from wheelleg_exp.build import build_env
from wheelleg_exp.child_process import call_limited
from wheelleg_exp.config.checking.find_mistakes import compose_valid, find_mistakes
from wheelleg_exp.config.config_errors import raise_all
from wheelleg_exp.errors import ConfigError, RunDirectoryError, SimulationFailure, WheellegError, printable
from wheelleg_exp.files import for_people, read_bytes, temporary_folder, write_bytes
from wheelleg_exp.isaaclab_import.agent_mapping import convert_agent, is_runner
from wheelleg_exp.isaaclab_import.author_terms import AuthorTerms
from wheelleg_exp.isaaclab_import.deploy_folders import as_isaac_lab
from wheelleg_exp.isaaclab_import.env_mapping import EnvMapping, is_version_3
from wheelleg_exp.isaaclab_import.import_report import ASSUMED, CODE, DROPPED, RULE, ImportReport
from wheelleg_exp.isaaclab_import.policy_weights import PolicyWeights, read_policy
from wheelleg_exp.isaaclab_import.run_folder import RunFolder, malformed, read_folder, read_names
from wheelleg_exp.jobs.export.isaaclab_run import Tree
from wheelleg_exp.jobs.job_display import Display
from wheelleg_exp.plain_data import dump_yaml
from wheelleg_exp.project.create import copy_robot, project_files, require_place, robot_file, write
from wheelleg_exp.rl import checkpoint

_POLICY = "imported_policy.pt"
_OPTIONAL = ("rewards", "curriculum", "events", "terminations")  # sections that do not change the policy
_NUM_ENVS = 16  # environments of the run directory, which only plays the policy
_ROBOT = "# @package env.robot\n# The robot of an imported run: docs/isaaclab.md. README.md lists what was assumed.\n"
_TASK = "# @package _global_\n# The task of an imported run. README.md lists what was assumed and dropped.\n"


@dataclass(frozen=True)
class Imported:
    """An imported folder: project, run directory (None without a policy), value of ``init_from_what``, and report."""

    path: Path
    run: Path | None
    what: str
    report: ImportReport


def import_apart(source: Path, robot: Path, place: Path, **options: Any) -> Imported:
    """Call ``import_run`` in a child process, because the author's code can end the process or use all memory."""
    path = require_place(place)
    try:
        importing = partial(import_run, source, robot_file(robot), place, **options)  # can download for minutes
        return call_limited(importing, key=str(source), seconds=120, gib=8)
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)
        with temporary_folder(path):  # removes the draft of a dead process
            pass
        raise


def import_run(
    source: Path,
    robot: Path,
    place: Path,
    *,
    policy: Path | None = None,
    terms: Path | None = None,
    names: Path | None = None,
    command: Sequence[str] = (),
    display: Display | None = None,
) -> Imported:
    """Import the folder ``source`` as a new project at ``place``.

    ``robot`` is the robot's USD or URDF file, ``policy`` a policy file that replaces the folder's own, and ``terms`` a
    folder with the author's Python code, of which only the needed definitions are copied. ``names`` is a YAML file that
    maps the run's names of joints and links to names in the robot file. An error leaves no files.
    """
    path = require_place(place)
    robot = robot_file(robot)
    folder, report, display = read_folder(source, policy), ImportReport(), display or Display()
    encoded = folder.kind == "params.yaml"
    weights = read_policy(folder.policy, encoded=encoded) if folder.policy is not None else None
    author = AuthorTerms(terms, path.name, is_version_3(folder.config))
    table = {} if names is None else read_names(names)
    with for_people(path), temporary_folder(path) as scratch:
        draft = scratch / path.name
        draft.mkdir()
        copied = copy_robot(robot, draft / "assets" / path.name)
        mapping, agent = _convert(folder, copied, weights, author, report, table)
        for network in mapping.networks:
            _copy_network(network, [folder.path, folder.config_file.parent, robot.parent], copied.parent)
        lost = [group for group in agent["obs_groups"]["actor"] if group in mapping.lost and weights is not None]
        if lost:
            row = mapping.lost[lost[0]]
            message, expected = row.text, "a policy without this observation"
            if row.outcome == CODE:
                message = "the policy observes a term that does not exist here"
                expected = "--terms FOLDER with the author's Python code"
            raise ConfigError(message, key=row.key, expected=expected)
        task = _write_project(draft, copied.name, mapping, agent, author)
        _remove_failing_terms(draft, task, report)
        draft.rename(path)
    try:
        run, what = None, ""
        _try_env(path, task, weights, report)
        if weights is not None:
            run, what = _write_run(path, weights, mapping.lost, command, display, report)
        write(path, {"README.md": printable(_readme(path.name, folder, what, report))})
    except BaseException:
        shutil.rmtree(path, ignore_errors=True)
        raise
    finally:
        projects.forget(path)
    return Imported(path, run, what, report)


def _convert(
    folder: RunFolder,
    robot: Path,
    weights: PolicyWeights | None,
    author: AuthorTerms,
    report: ImportReport,
    names: Mapping[str, str],
) -> tuple[EnvMapping, Tree]:
    bodies = read(robot, "auto", {})[0].bodies
    dofs = {dof.name: dof for body in bodies for dof in body.dofs}
    try:
        tree, settings, sizes = folder.config, folder.agent, Tree()
        if folder.kind != "env.yaml":
            tree, sizes = as_isaac_lab(folder, robot, dofs, report)
        clip = tree.pop("clip_actions", None)
        links = [body.name for body in bodies]
        mapping = EnvMapping(tree, dofs, author.target, report, names, links, robot.parent.name)
        mapping.convert()
        mapping.robot |= sizes  # of which the numbers of protocols are multiples
        if folder.joint_order is not None and sorted(folder.joint_order) == sorted(dofs):
            mapping.robot["joint_order"] = folder.joint_order
            report.add("joint_order", RULE, "the order in IO_descriptors.yaml")
        if settings is not None and not is_runner(settings):
            report.add("agent.yaml", DROPPED, "the settings of another library than rsl_rl")
            settings = None
        agent = convert_agent(settings, list(mapping.env["observations"]), weights, report)
    except (AttributeError, KeyError, TypeError, ValueError, IndexError, ArithmeticError) as error:
        raise malformed(folder.config_file, error) from error
    return mapping, agent if clip is None else agent | {"clip_actions": clip}


def _write_project(draft: Path, robot: str, mapping: EnvMapping, agent: Tree, author: AuthorTerms) -> Tree:
    name = draft.name
    finite = {"_target_": "wheelleg_exp.mdp.terminations.non_finite_state"}
    mapping.env["terminations"].setdefault("non_finite_state", finite)
    task: Tree = {"defaults": [{"/robot": name}, {"/sim": "parity"}, "_self_"]}
    task |= {"task": {"name": name}, "env": mapping.env, "agent": {k: v for k, v in agent.items() if v != {}}}
    if mapping.seed is not None:
        task["seed"] = mapping.seed
    asset = {"profile": name, "asset": f"{name}/{robot}"}
    texts = {f"configs/robot/{name}.yaml": _ROBOT + dump_yaml(asset | mapping.robot)}
    common = project_files(name, asset["asset"])
    texts |= {file: common[file] for file in ("pyproject.toml", ".gitignore", f"{name}/__init__.py")}
    texts |= {f"{name}/{module}.py": text for module, text in author.modules().items()}
    write(draft, texts)
    _write_task(draft, task)
    return task


def _write_task(project: Path, task: Tree) -> None:
    write(project, {f"configs/task/{project.name}.yaml": _TASK + dump_yaml(task)})


def _remove_failing_terms(draft: Path, task: Tree, report: ImportReport) -> None:
    """Check the task without those of the author's terms that fail; raise all other mistakes."""
    try:
        while mistakes := find_mistakes([f"task={draft.name}"], config_dirs=[draft / projects.CONFIGS])[1]:
            removed = [_without_failing_term(draft, task, mistake, report) for mistake in mistakes]
            if not any(removed):
                for mistake in mistakes:
                    mistake.where = None  # the file of the draft
                raise_all(mistakes)
    finally:
        projects.forget(draft)


def _write_run(
    path: Path,
    weights: PolicyWeights,
    lost: Collection[str],
    command: Sequence[str],
    display: Display,
    report: ImportReport,
) -> tuple[Path, str]:
    from wheelleg_exp.jobs.train.prepare_training import prepare
    from wheelleg_exp.jobs.train.run_training import record_untrained

    configs = [path / projects.CONFIGS]
    agent = compose_valid([f"task={path.name}"], config_dirs=configs).config["agent"]
    actor, critic = weights.actor.state(), weights.critic.state() if weights.critic is not None else {}
    std = weights.std
    if std is None:
        init = agent["actor"]["distribution_cfg"]["init_std"]
        std = torch.full((weights.actor.widths[1],), float(init))
        report.add("policy", ASSUMED, f"a standard deviation of {init} of the actions, for training only")
    if agent["actor"]["distribution_cfg"].get("std_type") == "log":
        actor["distribution.log_std_param"] = std.detach().log()
    else:
        actor["distribution.std_param"] = std.detach().clone()
    state = {"format_version": checkpoint.FORMAT_VERSION, "iter": weights.iteration, "actor_state_dict": actor}
    state["critic_state_dict"] = critic
    what = "policy"
    if critic and not set(lost) & set(agent["obs_groups"]["critic"]):
        what = "networks"
        if weights.optimizer is not None:
            what, state["optimizer_state_dict"] = "learning", dict(weights.optimizer)
    else:
        report.add("policy", ASSUMED, "a new critic: training must first learn the values of states")
    report.add("policy", RULE, f"{weights.path.name}: {what}, of iteration {weights.iteration}")
    write_bytes(path / _POLICY, checkpoint.serialize(state))
    words = [f"task={path.name}", f"init_from={path / _POLICY}", f"init_from_what={what}", f"run.root={path / 'runs'}"]
    words += [f"env.num_envs={_NUM_ENVS}", "run.name=imported", "recording.enabled=false"]
    training = prepare(compose_valid(words, config_dirs=configs), command, display)
    record_untrained(training, display)
    return training.directory.path, what


def _try_env(path: Path, task: Tree, weights: PolicyWeights | None, report: ImportReport) -> None:
    """Make a control step of the task without those of the author's terms that fail, and compare the policy's width."""
    words = [f"task={path.name}", "env.num_envs=2"]
    while True:
        composed = compose_valid(words, config_dirs=[path / projects.CONFIGS])
        try:
            env = build_env(composed.config, composed.asset_roots)
            env.reset()
            env.step(torch.zeros(2, env.num_actions, device=env.device))
            break
        except (ConfigError, SimulationFailure) as error:
            if not _without_failing_term(path, task, error, report):
                raise
    if composed.config["env"]["robot"]["joint_order"] is None:
        names = ", ".join(env.scene.robot.joint_names)
        report.add("joint_order", ASSUMED, f"{names}: breadth first in the robot file; set joint_order to change it")
    if weights is None:
        return
    manager, group = env.observation_manager, composed.config["agent"]["obs_groups"]["actor"][0]
    dims = [int(torch.tensor(dim).prod()) for dim in manager.group_obs_term_dim[group]]
    given, needed = (sum(dims), env.num_actions), weights.actor.widths
    if given != needed:
        message = f"the policy has {needed[0]} observations and {needed[1]} actions, the task {given[0]} and {given[1]}"
        terms = ", ".join(f"{name} {dim}" for name, dim in zip(manager.active_terms[group], dims, strict=True))
        expected = f"the policy of the run; observations: {terms}"
        raise RunDirectoryError(message, key=str(weights.path), expected=expected)


def _copy_network(name: str, folders: Sequence[Path], to: Path) -> None:
    """Copy the file of an actuator network, which Isaac Lab loads from a server, from one of some folders."""
    found = next((folder / name for folder in folders if (folder / name).is_file()), None)
    if found is None:
        message = f"the run has an actuator with the network '{name}'"
        raise ConfigError(message, key="network_file", expected=f"this file in {folders[0]}")
    write_bytes(to / name, read_bytes(found))


def _without_failing_term(path: Path, task: Tree, error: WheellegError, report: ImportReport) -> bool:
    """Remove the author's term that an error names from the task, unless the policy needs the term."""
    parts = (error.key or "").split(".")
    section = task["env"].get(parts[1]) if len(parts) > 2 and parts[1] in _OPTIONAL else None
    if not section or not str(section.get(parts[2], {}).get("_target_")).startswith(f"{path.name}."):
        return False
    del section[parts[2]]
    report.replace(".".join(parts[1:3]), CODE, f"the copied function fails: {error.message}")
    _write_task(path, task)
    return True


def _readme(name: str, folder: RunFolder, what: str, report: ImportReport) -> str:
    commands = f"wheelleg train task={name}"
    if what:
        commands = f"""wheelleg play latest --drive            # drive the robot, or: wheelleg play latest
wheelleg evaluate latest protocol=walk  # measure the policy
wheelleg train task={name} init_from={_POLICY} init_from_what={what}   # train further"""
    return f"""# {name}

Imported from `{folder.path.name}/{folder.config_file.name}`. `configs/robot/{name}.yaml` and `configs/task/{name}.yaml`
are the robot and the task.{" `runs/` has a run directory with the policy." if what else ""}

```bash
{commands}
```

# What was imported

{report.markdown()}"""
