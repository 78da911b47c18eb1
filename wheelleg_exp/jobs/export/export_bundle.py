"""Export a trained policy as a bundle: one folder that runs without this package.

The folder is written atomically, after each policy file has given the same actions as the trained policy in simulation.
"""

from __future__ import annotations

import copy
import io
import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from wheelleg_exp import files
from wheelleg_exp.config.tree_lookup import section_at
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.realism import without_realism
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.export import bundle, bundle_specification
from wheelleg_exp.jobs.export.bundle import runner
from wheelleg_exp.jobs.export.bundle_check import READING, TOLERANCE, TOLERANCE_FLOAT32, compare, recorded_episodes
from wheelleg_exp.jobs.export.bundle_readme import readme
from wheelleg_exp.jobs.export.c_header import c_header
from wheelleg_exp.jobs.export.isaaclab_run import write_isaac_lab_run
from wheelleg_exp.jobs.export.leapp_bundle import leapp_readings, write_leapp
from wheelleg_exp.jobs.export.policy_json import PolicyJson
from wheelleg_exp.jobs.saved_evaluation import Margin, margins_of
from wheelleg_exp.jobs.saved_robot import REPORT, saved_mjcf
from wheelleg_exp.jobs.torch_threads import set_threads
from wheelleg_exp.machine import require_memory
from wheelleg_exp.managers.scene_manager import SceneManager
from wheelleg_exp.mdp.commands import JumpCommand
from wheelleg_exp.rl import checkpoint as checkpoints
from wheelleg_exp.rl import export as formats
from wheelleg_exp.rl.network_loading import load_policy
from wheelleg_exp.rl.options import read_agent
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.run.run_config import load_params, on_reference_engine, upgrade_env_params
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.sim.options import read_env
from wheelleg_exp.terms.config_sections import plain_section

_BIAS = "wheelleg_exp.mdp.events.randomize_encoder_bias"
_RESET = "wheelleg_exp.mdp.events.reset_joints_by_scale"
_ENTITY = "wheelleg_exp.managers.SceneEntityCfg"
_PLANE = "wheelleg_exp.sim.terrain.Plane"


def as_configured(env: Mapping[str, object]) -> dict[str, object]:
    """Return a copy of the ``env`` config with one environment, and without events, curricula, and recorders."""
    sim = {**section_at(env, "sim"), "nthread": 1}
    return copy.deepcopy({**env, "sim": sim, "num_envs": 1, "events": {}, "curriculum": {}, "recorders": {}})


def as_checked(env: Mapping[str, object], rolling_joints: Sequence[str]) -> dict[str, object]:
    """Return the ``env`` config of the simulation in which the exported policy files are checked.

    It has no noise, delays, encoder errors, pushes, or randomization. Wheel joints start at their default positions,
    because the exported ``runner.py`` counts wheel angles from the reset.
    """
    tree = plain_section(without_realism(read_env(env)))
    found: dict[str, Any] = as_configured(tree)
    events = {name: node for name, node in tree["events"].items() if node is not None and node["_target_"] != _BIAS}
    found["events"] = {name: copy.deepcopy(node) for name, node in events.items() if node["mode"] == "reset"}
    if rolling_joints:
        joints = {"_target_": _ENTITY, "name": "robot", "joint_names": [*map(re.escape, rolling_joints)]}
        still = {"position_range": [1.0, 1.0], "velocity_range": [1.0, 1.0], "asset_cfg": joints}
        found["events"]["rolling_joints_at_default"] = {"_target_": _RESET, "mode": "reset", **still}
    for group in (group for group in found["observations"].values() if group is not None):
        group["enable_corruption"] = False
        for node in (node for node in group["terms"].values() if node is not None):
            node |= {"delay": None, "delay_jitter": 0}
    for node in (node for node in found["actions"].values() if node is not None):
        node |= {"delay": None, "delay_jitter": 0}
    return found


def with_metadata(model: bytes, spec: PolicyJson) -> bytes:
    """Return an ONNX model with the content of ``policy.json`` as metadata; as in mjlab, a list is comma-separated."""
    loaded = onnx.load_from_string(model)
    terms = [term for group in spec["observations"] for term in group["terms"]]
    about = {
        "joint_names": _comma_separated(spec["joint_names"]),
        "joint_stiffness": _comma_separated(spec["stiffness"]),
        "joint_damping": _comma_separated(spec["damping"]),
        "default_joint_pos": _comma_separated(spec["default_joint_pos"]),
        "command_names": _comma_separated(spec["commands"]),
        "observation_names": _comma_separated(term["name"] for term in terms),
        "action_joint_names": _comma_separated(name for action in spec["actions"] for name in action["joint_names"]),
        "step_dt": str(spec["step_dt"]),
        "decimation": str(spec["decimation"]),
        "policy.json": files.dump_json(spec),
    }
    for key in ("scale", "offset"):
        if all(key in action for action in spec["actions"]):
            about[f"action_{key}"] = _comma_separated(value for action in spec["actions"] for value in action[key])
    for key, value in about.items():
        entry = loaded.metadata_props.add()
        entry.key, entry.value = key, value
    return bytes(loaded.SerializeToString())


def _comma_separated(values: Iterable[object]) -> str:
    return ",".join("" if value is None else str(value) for value in values)


BUNDLE, LEAPP, ISAAC_LAB = "bundle", "leapp", "isaaclab"
_COPIED_FILES = ("runner.py", "simulate.py", "chirps.py")
_MOST_STEPS, _EXAMPLE_STEPS = 600, 120
_SKIPPED_FILES = (REPORT, "asset.json")


@dataclass(frozen=True)
class Exported:
    """The result of an export."""

    run: RunDirectory
    checkpoint: Path
    folder: Path
    differences: Mapping[str, float]  # maps each policy file to its largest action difference from the trained policy
    notes: Sequence[str]  # Each text explains why a file or feature is missing in the exported folder.
    margins: Sequence[Margin]  # the margins that evaluations of the checkpoint measured


def export(
    run: RunDirectory, checkpoint: Path | None, output: Path | None, command: Sequence[str], kind: str = BUNDLE
) -> Exported:
    """Write a run's policy (default: the last checkpoint) as a bundle, by default into the run's ``exported/<kind>``.

    If this folder exists, the new name gets a number. ConfigError means that ``runner.py`` cannot compute the policy,
    and SimulationFailure that a policy file gives other actions than the simulation; then nothing is written.
    """
    if kind == LEAPP and find_spec(LEAPP) is None:
        raise ConfigError("leapp is not installed", key="--format", expected="pip install 'wheelleg_exp[leapp]'")
    checkpoint = run.latest_checkpoint() if checkpoint is None else checkpoint
    if output is not None:
        files.require_new(output)
    target = run.exported / kind if output is None else output.absolute()
    with files.for_people(target), files.temporary_folder(target) as work:
        margins = margins_of(run.manifest().facts.additions, files.sha256(checkpoint))
        differences, notes = _fill(work, run, checkpoint, kind, margins)
        files.sync_folder(work)
        number, place = 1, target
        while place.exists() or place.is_symlink():
            if output is not None:
                files.require_new(place)
            number += 1
            place = target.with_name(f"{target.name}-{number}")
        with files.for_people(place):
            work.rename(place)
        folder = place.resolve()
    if folder.is_relative_to(run.path):
        results: dict[str, object] = {"folder": str(folder.relative_to(run.path)), "checkpoint": checkpoint.name}
        results |= {"largest_difference": differences, "lacks": notes}
        try:
            written = sorted(path for path in folder.rglob("*") if path.is_file())
            run.manifest().add("export", written, results, command=command)
        except BaseException:  # Remove an exported folder that the run's manifest does not list.
            shutil.rmtree(folder, ignore_errors=True)
            raise
    return Exported(run, checkpoint, folder, differences, notes, margins)


def _fill(
    folder: Path, run: RunDirectory, checkpoint: Path, kind: str, margins: Sequence[Margin]
) -> tuple[dict[str, float], list[str]]:
    """Write all files of the exported folder; return the fields ``differences`` and ``notes`` of ``Exported``."""
    params, agent = load_params(run)
    params, seed = on_reference_engine(upgrade_env_params(params)), int(run.manifest().data["seeds"][0])
    role = next((role for role in bundle_specification.ROLES if role in agent), None)
    if role is None:
        expected = f"one of {', '.join(bundle_specification.ROLES)}"
        raise ConfigError("the run has no policy", key="agent", expected=expected)
    bundle_specification.require_perceptron(agent[role], f"agent.{role}")
    groups = agent["obs_groups"][role]
    mjcf, state = saved_mjcf(run), checkpoints.load(checkpoint)
    if kind == ISAAC_LAB:
        env = ManagerBasedRLEnv({**params, "num_envs": 1}, mjcf, seed)
        policy = load_policy(checkpoint, RslRlVecEnv(env, agent.get("clip_actions")), read_agent(agent))
        task = str(run.manifest().data.get("task"))
        return {}, write_isaac_lab_run(folder, env, int(str(params["num_envs"])), agent, policy, task)
    plain = ManagerBasedRLEnv(as_configured(params), mjcf, seed)
    _require_unchanged(state)
    plain_spec = bundle_specification.specification(plain, agent, _ranges(plain, state))
    steps = min(2 * plain.max_episode_length, _MOST_STEPS)
    width = plain_spec["observation_width"]
    require_memory(4 * steps * width, f"env.observations.{groups[0]}", f"{steps} recorded steps of {width:,} numbers")
    env = ManagerBasedRLEnv(as_checked(params, plain_spec["rolling_joints"]), mjcf, seed)
    set_threads(read_agent(agent), env.scene.sim.nthread)
    adapter = RslRlVecEnv(env, agent.get("clip_actions"))
    policy = load_policy(checkpoint, adapter, read_agent(agent))
    network, arrays = bundle_specification.network_arrays(policy, role)
    # In float32, torch and NumPy would give different actions, because they round sums differently.
    precise = copy.deepcopy(policy).double()
    names = list(leapp_readings(plain_spec).values() if kind == LEAPP else plain_spec["readings"])
    recorded = recorded_episodes(
        adapter, lambda seen: precise(seen.double()).float(), policy, groups, names, agent.get("clip_actions"), steps
    )
    spec: PolicyJson = {
        "format_version": plain_spec["format_version"],
        "run": {
            "id": run.id,
            "task": run.manifest().data.get("task"),
            "iteration": state["iter"],
            "checkpoint": checkpoint.name,
            "checkpoint_sha256": files.sha256(checkpoint),
        },
        **plain_spec,
        "network": network,
        "check": {"file": "check.npz", "steps": steps, "tolerance": TOLERANCE, "tolerance_float32": TOLERANCE_FLOAT32},
        "margins": [{"name": m.name, "unit": m.unit, "policy": m.policy, "reference": m.reference} for m in margins],
    }
    if kind == LEAPP:
        return write_leapp(folder, spec, plain, policy.as_onnx(verbose=False), recorded)
    files.write_bytes(folder / "policy.npz", _npz(arrays))
    files.write_bytes(folder / "check.npz", _npz(recorded))
    for name in _COPIED_FILES:
        files.write_text(folder / name, Path(str(bundle.__file__)).with_name(name).read_text(encoding="utf-8"))
    files.write_json(folder / "policy.json", spec)
    torchscript, onnx, header = formats.torchscript(policy), formats.onnx(policy), c_header(spec, arrays)
    differences, notes = compare(folder, torchscript, onnx, header)
    spec["check"]["largest_difference"] = differences
    files.write_json(folder / "policy.json", spec)
    files.write_bytes(folder / "policy.pt", torchscript)
    files.write_bytes(folder / "policy.onnx", with_metadata(onnx, spec))
    if not notes:
        files.write_text(folder / "policy.h", header)
        shutil.copytree(Path(str(bundle.__file__)).with_name("example"), folder / "example")
        files.write_text(folder / "example" / "readings.csv", _readings_csv(spec, recorded))
    notes += _write_robot(folder / "robot", mjcf, params, plain, spec["readings"])
    names = [str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()]
    files.write_text(folder / "README.md", readme(spec, names, notes))
    return differences, notes


def _ranges(env: ManagerBasedRLEnv, state: Mapping[str, object]) -> dict[str, dict[str, list[float]]]:
    """Return the command ranges at the end of training, which a curriculum may have widened."""
    found: dict[str, dict[str, list[float]]] = {}
    for name in env.command_manager.active_terms:
        command = env.command_manager.get_term(name)
        ranges = getattr(command, "ranges", None) or {}
        if isinstance(command, JumpCommand):
            ranges = {"jump": [0.0, 1.0]} | ({"height": [0.0, command.highest]} if command.highest else {})
        term = checkpoints.env_state(state).get("managers", {}).get("commands", {}).get("terms", {}).get(name, {})
        changed = (term.get("object") or {}).get("ranges")
        found[name] = dict(ranges) if changed is None else changed
    return found


def _require_unchanged(state: Mapping[str, object]) -> None:
    """Raise ConfigError if a curriculum changed settings of action terms or observation terms during training."""
    managers = checkpoints.env_state(state).get("managers", {})
    terms = {f"env.actions.{name}": term for name, term in managers.get("actions", {}).get("terms", {}).items()}
    for group, found in managers.get("observations", {}).get("groups", {}).items():
        terms |= {f"env.observations.{group}.terms.{name}": term["term"] for name, term in found.items()}
    for key, term in terms.items():
        if term.get("settings"):
            message = "the training changed its settings (" + ", ".join(term["settings"]) + ")"
            raise ConfigError(message, key=key, expected="the settings of the config, from which the export is made")


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **dict(arrays))  # type: ignore[arg-type]
    return buffer.getvalue()


def _readings_csv(spec: PolicyJson, recorded: Mapping[str, np.ndarray]) -> str:
    """Return the readings of the first recorded episode as CSV, in the layout of a robot log."""
    steps = int(np.append(np.flatnonzero(recorded["reset"]), len(recorded["reset"]))[1])
    names = [c for n, r in spec["readings"].items() for c in runner.columns(n, r["width"], spec["joint_names"])]
    rows = [spec["step_dt"] * np.arange(steps)[:, None], *(recorded[READING + n][:steps] for n in spec["readings"])]
    buffer = io.StringIO()
    np.savetxt(buffer, np.hstack(rows)[:_EXAMPLE_STEPS], "%.9g", ",", header=",".join(["time", *names]), comments="")
    return buffer.getvalue()


def _write_robot(
    folder: Path, mjcf: Path, params: Mapping[str, object], env: ManagerBasedRLEnv, readings: Iterable[str] = ()
) -> list[str]:
    """Write the robot and its scene as MJCF files; return notes about parts that ``simulate.py`` cannot simulate."""
    with files.for_people(folder):
        shutil.copytree(mjcf.parent, folder, ignore=shutil.ignore_patterns(*_SKIPPED_FILES))
    ground = env.scene.terrain
    friction = (ground.static_friction, ground.dynamic_friction, ground.restitution)
    # Build the ``env`` config of a scene that contains only the robot and level ground.
    found = as_configured(params)
    names = ("static_friction", "dynamic_friction", "restitution")
    plane = {"_target_": _PLANE, **dict(zip(names, friction, strict=True))}
    found["scene"] = {**section_at(params, "scene"), "terrain": plane, "sensors": {}}
    scene = SceneManager(found, mjcf, 1).scene
    scene.play()
    files.write_text(folder / "scene.xml", scene.spec.to_xml())
    strange = [
        f"the drive `{name}`"
        for name, group in env.scene.robot.actuators.items()
        if bundle_specification.drive_law(group) is None
    ]
    strange += [f"the reading `{name}`" for name in readings if name.endswith(".lin_acc")]
    strange += [] if env.scene.robot.floating else ["a fixed base"]
    return [f"a simulation of {what}, which `simulate.py` refuses" for what in strange]
