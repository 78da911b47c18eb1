"""Exporting a run: its policy, its robot and a runner in one folder, held against the simulation that trained it."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.files import (
    for_people,
    require_new,
    sha256,
    sync_folder,
    temporary_folder,
    write_bytes,
    write_json,
    write_text,
)
from wheelleg_exp.jobs.export import bundle
from wheelleg_exp.jobs.export.c_header import c_header
from wheelleg_exp.jobs.export.deployment import as_checked, as_configured, as_simulated
from wheelleg_exp.jobs.export.drives import law
from wheelleg_exp.jobs.export.network import ROLES, in_float64, network_arrays, require_perceptron
from wheelleg_exp.jobs.export.onnx_metadata import with_metadata
from wheelleg_exp.jobs.export.policy_comparison import TOLERANCE, TOLERANCE_FLOAT32, compare
from wheelleg_exp.jobs.export.readme import readme
from wheelleg_exp.jobs.export.recorded import recorded_episodes
from wheelleg_exp.jobs.export.specification import specification
from wheelleg_exp.jobs.kept_robot import REPORT, kept_mjcf
from wheelleg_exp.jobs.threads import set_threads
from wheelleg_exp.managers.scene_manager import SceneManager
from wheelleg_exp.memory import require_memory
from wheelleg_exp.rl import checkpoint as checkpoints
from wheelleg_exp.rl import export as formats
from wheelleg_exp.rl.policy import load_policy
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.run.directory import RunDirectory
from wheelleg_exp.run.params import load_params, on_reference_engine, present_form
from wheelleg_exp.state.rebuilding import made_again

BUNDLE = "bundle"
_AS_THEY_STAND = ("runner.py", "simulate.py")
_MOST_STEPS = 600
_NOT_OF_THE_ROBOT = (REPORT, "asset.json")


@dataclass(frozen=True)
class Exported:
    """What an export made.

    Attributes:
        run: the run whose policy it is.
        checkpoint: the checkpoint.
        folder: the bundle.
        differences: the largest differences of its policies from the simulation that trained it, step by step.
        notes: what the bundle lacks, and why.
    """

    run: RunDirectory
    checkpoint: Path
    folder: Path
    differences: Mapping[str, float]
    notes: Sequence[str]


def export(run: RunDirectory, checkpoint: Path | None, output: Path | None, command: Sequence[str]) -> Exported:
    """Write a run's policy as a folder that a deployer can use without this program.

    Args:
        run: the run.
        checkpoint: which of its checkpoints; None is the last.
        output: the folder to make; None is ``exported/bundle`` of the run, with a number when that is taken.
        command: the command line, for the manifest.

    Raises:
        ConfigError: a part of the policy cannot work without the simulation: which, and what can.
        RunDirectoryError: the run or the checkpoint is wrong, or the folder exists.
        SimulationFailure: a policy of the bundle differs from what the simulation recorded; nothing is written.
    """
    checkpoint = run.latest_checkpoint() if checkpoint is None else checkpoint
    if output is not None:
        require_new(output)
    target = run.exported / BUNDLE if output is None else output.absolute()
    with for_people(target), temporary_folder(target) as work:
        differences, notes = _fill(work, run, checkpoint)
        sync_folder(work)
        folder = _placed(work, target, numbered=output is None)
    if folder.is_relative_to(run.path):
        results = {"checkpoint": checkpoint.name, "largest_difference": differences, "lacks": notes}
        try:
            _recorded(run, folder, results, command)
        except BaseException:  # what the manifest does not name is not of the run
            shutil.rmtree(folder, ignore_errors=True)
            raise
    return Exported(run, checkpoint, folder, differences, notes)


def _recorded(run: RunDirectory, folder: Path, results: Mapping[str, Any], command: Sequence[str]) -> None:
    """Add a bundle below its run to the manifest."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    place = str(folder.relative_to(run.path))
    run.manifest().add("export", files, {"folder": place, **results}, command=command)


def _placed(work: Path, target: Path, *, numbered: bool) -> Path:
    """Give a finished folder its name; a taken one gets a number, or is refused."""
    number, place = 1, target
    while place.exists() or place.is_symlink():
        if not numbered:
            require_new(place)
        number += 1
        place = target.with_name(f"{target.name}-{number}")
    with for_people(place):
        work.rename(place)
    return place.resolve()


def _fill(folder: Path, run: RunDirectory, checkpoint: Path) -> tuple[dict[str, float], list[str]]:
    """Write the bundle's files and return how far its runner is from the simulation, and what it lacks."""
    params, agent = load_params(run)
    params, seed = on_reference_engine(present_form(params)), int(run.manifest().data["seeds"][0])
    role = next(role for role in ROLES if role in agent)
    require_perceptron(agent[role], f"agent.{role}")
    groups = agent["obs_groups"][role]
    mjcf, state = kept_mjcf(run), checkpoints.load(checkpoint)
    plain = ManagerBasedRLEnv(as_configured(params), mjcf, seed)
    _require_unchanged(state)
    spec = specification(plain, agent, _ranges(plain, state))
    steps = min(2 * plain.max_episode_length, _MOST_STEPS)
    need = 4 * steps * spec["observation_width"]
    require_memory(
        need, f"env.observations.{groups[0]}", f"{steps} recorded steps of {spec['observation_width']:,} numbers"
    )
    env = ManagerBasedRLEnv(as_checked(params, spec["rolling_joints"]), mjcf, seed)
    set_threads(agent, env.scene.sim.nthread)
    adapter = RslRlVecEnv(env, agent.get("clip_actions"))
    policy = load_policy(checkpoint, adapter, agent)
    network, arrays = network_arrays(policy, role)
    recorded = recorded_episodes(
        adapter, in_float64(policy), policy, groups, list(spec["readings"]), agent.get("clip_actions"), steps
    )
    spec = {"format_version": spec.pop("format_version"), "run": _about(run, checkpoint, state), **spec}
    about = {"file": "check.npz", "steps": steps, "tolerance": TOLERANCE, "tolerance_float32": TOLERANCE_FLOAT32}
    spec |= {"network": network, "check": about}
    write_bytes(folder / "policy.npz", _npz(arrays))
    write_bytes(folder / "check.npz", _npz(recorded))
    for name in _AS_THEY_STAND:
        write_text(folder / name, Path(str(bundle.__file__)).with_name(name).read_text(encoding="utf-8"))
    write_json(folder / "policy.json", spec)
    torchscript, onnx, header = formats.torchscript(policy), formats.onnx(policy), c_header(spec, arrays)
    differences, notes = compare(folder, torchscript, onnx, header)
    spec["check"]["largest_difference"] = differences
    write_json(folder / "policy.json", spec)
    write_bytes(folder / "policy.pt", torchscript)
    write_bytes(folder / "policy.onnx", with_metadata(onnx, spec))
    if not notes:
        write_text(folder / "policy.h", header)
    notes += _write_robot(folder / "robot", mjcf, params, plain, spec["readings"])
    files = [str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()]
    write_text(folder / "README.md", readme(spec, files, notes))
    return differences, notes


def _about(run: RunDirectory, checkpoint: Path, state: Mapping[str, Any]) -> dict[str, Any]:
    about = {"id": run.id, "task": run.manifest().data.get("task"), "iteration": state["iter"]}
    return about | {"checkpoint": checkpoint.name, "checkpoint_sha256": sha256(checkpoint)}


def _ranges(env: ManagerBasedRLEnv, state: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ranges of each command as the training has left them: a curriculum may have widened them."""
    found = {}
    for name in env.command_manager.active_terms:
        ranges = dict(getattr(env.command_manager.get_term(name), "ranges", {}) or {})
        term = state.get("env", {}).get("managers", {}).get("commands", {}).get("terms", {}).get(name, {})
        changed = (term.get("object") or {}).get("ranges")
        found[name] = ranges if changed is None else made_again(changed)
    return found


def _require_unchanged(state: Mapping[str, Any]) -> None:
    """Refuse a training that has changed settings of actions or observations since its config was written."""
    managers = state.get("env", {}).get("managers", {})
    terms = {f"env.actions.{name}": term for name, term in managers.get("actions", {}).get("terms", {}).items()}
    for group, found in managers.get("observations", {}).get("groups", {}).items():
        terms |= {f"env.observations.{group}.terms.{name}": term["term"] for name, term in found.items()}
    for key, term in terms.items():
        if term.get("settings"):
            raise ConfigError(
                "its settings were changed while training (" + ", ".join(term["settings"]) + ")",
                key=key,
                expected="the settings of the config: what is exported is read from there",
            )


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **dict(arrays))  # type: ignore[arg-type]
    return buffer.getvalue()


def _write_robot(
    folder: Path, mjcf: Path, params: Mapping[str, Any], env: ManagerBasedRLEnv, readings: Iterable[str] = ()
) -> list[str]:
    """Write the robot's files and its scene; return what is missing."""
    with for_people(folder):
        shutil.copytree(mjcf.parent, folder, ignore=shutil.ignore_patterns(*_NOT_OF_THE_ROBOT))
    ground = env.scene.terrain
    friction = (ground.static_friction, ground.dynamic_friction, ground.restitution)
    scene = SceneManager(as_simulated(params, friction), mjcf, 1).scene
    scene.play()
    write_text(folder / "scene.xml", scene.spec.to_xml())
    strange = [f"the drive `{name}`" for name, group in env.scene.robot.actuators.items() if law(group) is None]
    strange += [f"the reading `{name}`" for name in readings if name.endswith(".lin_acc")]
    strange += [] if env.scene.robot.floating else ["a fixed base"]
    return [f"a simulation of {what}, which `simulate.py` refuses" for what in strange]
