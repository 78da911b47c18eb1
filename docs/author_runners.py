"""Compare an imported policy with its author's runner, which is rewritten here from the author's source in NumPy.

    python docs/author_runners.py PROJECT SOURCE POLICY

PROJECT is the project that ``wheelleg import SOURCE --policy POLICY`` made. The simulation gives 200 states; both sides
compute the observation, the action, and the targets of the joints. The largest differences are printed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from numpy.typing import NDArray
from tensordict import TensorDict

from wheelleg_exp.build import build_env
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.rl.network_loading import load_policy
from wheelleg_exp.rl.options import Agent
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.terms.config_sections import read_section

Array = NDArray[np.float64]
ENVS, STEPS = 8, 25  # 200 states


def gravity(quat: Array) -> Array:
    """Return the direction of gravity in the axes of the base, (N, 3), from its rotation (w, x, y, z), (N, 4)."""
    w, x, y, z = quat.T
    return np.stack((-2 * (x * z - w * y), -2 * (y * z + w * x), -(1 - 2 * (x * x + y * y))), 1)


class RlSar:
    """The runner of rl_sar at e384912: ``ComputeObservation``, ``Forward``, and ``ComputeOutput`` of its RL class."""

    def __init__(self, source: Path, policy: Path) -> None:
        bases = [folder / "base.yaml" for folder in (source, source.parent)]
        files = [*(base for base in bases if base.is_file()), source / "config.yaml"]
        self.config = {k: v for file in files for k, v in next(iter(yaml.safe_load(file.read_text()).values())).items()}
        names = self.config["joint_names"]
        self.joints = [names[index] for index in self.config["joint_mapping"]]
        self.wheels = self.config["wheel_indices"]
        self.model = torch.jit.load(str(policy))
        self.last = np.zeros((ENVS, len(self.joints)))
        self.history: list[Array] = []  # the newest first

    def reset(self, done: NDArray[np.bool_]) -> None:
        """Reset the last actions and the history of the robots that fell."""
        self.last[done] = 0.0
        self.fresh = done

    def observe(self, read: Mapping[str, Array]) -> Array:
        """Return one observation, (N, D), from readings of the IMU and of the joints in the runner's order."""
        config = self.config
        angles = read["q"] - config["default_dof_pos"]
        angles[:, self.wheels] = 0.0
        parts = {
            "ang_vel": read["gyro"] * config["ang_vel_scale"],
            "gravity_vec": gravity(read["quat"]),
            "commands": read["command"] * config["commands_scale"],
            "dof_pos": angles * config["dof_pos_scale"],
            "dof_vel": read["dq"] * config["dof_vel_scale"],
            "actions": self.last,
        }
        return np.clip(np.concatenate([parts[name] for name in config["observations"]], 1), *_CLIP)

    def remember(self, observation: Array, length: int) -> None:
        """Insert an observation in front of the history; robots that start have only this one."""
        self.history = [observation.copy(), *(self.history or [observation.copy()] * (length - 1))][:length]
        for older in self.history:
            older[self.fresh] = observation[self.fresh]

    def step(self, read: Mapping[str, Array]) -> tuple[Array, Array, Array]:
        """Return what the network observes, its actions, and the targets of the joints: speeds of wheels, angles."""
        seen, ids = self.observe(read), self.config["observations_history"]
        if ids:
            self.remember(seen, max(ids) + 1)
            seen = np.concatenate([self.history[index] for index in ids], 1)
        actions = self.model(torch.tensor(seen, dtype=torch.float32)).detach().numpy().astype(float)
        self.last = np.clip(actions, self.config["clip_actions_lower"], self.config["clip_actions_upper"])
        targets = self.last * self.config["action_scale"] + self.config["default_dof_pos"]
        targets[:, self.wheels] = (self.last * self.config["action_scale"])[:, self.wheels]
        return seen, self.last, targets


class Limx(RlSar):
    """``WheelfootController`` of tron1-rl-deploy-python at 08b1f11, without its limit of the legs' torque."""

    def __init__(self, source: Path, policy: Path) -> None:
        config = yaml.safe_load((source / "params.yaml").read_text())["PointfootCfg"]
        names, control, scales = config["joint_names"], config["control"], config["normalization"]["obs_scales"]
        half = len(names) // 2
        lab = policy.parent.name == "isaaclab"
        order = [index for left in range(half) for index in (left, left + half)] if lab else list(range(2 * half))
        self.scales = scales["ang_vel"], scales["dof_pos"], scales["dof_vel"]
        self.observed = np.array([1.0] * 3 if lab else [scales["lin_vel"]] * 2 + [scales["ang_vel"]])
        wheels = [place for place, index in enumerate(order) if index not in config["size"]["jointpos_idxs"]]
        factors = (control["action_scale_pos"], control["wheel_joint_damping"])
        default = config["init_state"]["default_joint_angle"]
        self.prepare(policy, [names[index] for index in order], wheels, default, factors)
        self.length = config["size"]["obs_history_length"]

    def prepare(
        self, policy: Path, joints: list[str], wheels: list[int], default: Mapping[str, float], factors: Sequence[float]
    ) -> None:
        """Load the networks, and store joints, wheels, and the factors of the actions of legs and wheels."""
        self.encoder, self.policy = (_session(file) for file in (policy.with_name("encoder.onnx"), policy))
        self.joints, self.wheels = joints, wheels
        self.legs = [i for i in range(len(joints)) if i not in wheels]
        self.default = np.array([default[name] for name in joints])
        self.factors = np.array([factors[i in wheels] for i in range(len(joints))])
        self.last, self.history = np.zeros((ENVS, len(joints))), []

    def step(self, read: Mapping[str, Array]) -> tuple[Array, Array, Array]:  # noqa: D102
        turning, angle, speed = self.scales
        angles = (read["q"] - self.default)[:, self.legs] * angle
        one = np.concatenate((read["gyro"] * turning, gravity(read["quat"]), angles, read["dq"] * speed, self.last), 1)
        self.remember(one, self.length)
        seen = np.concatenate(self.history[::-1], 1)
        observed = read["command"] * self.observed
        codes = [_run(self.encoder, row) for row in seen]
        rows = np.concatenate((codes, np.clip(one, *_CLIP), observed), 1)
        self.last = np.clip([_run(self.policy, row) for row in rows], *_CLIP)
        targets = self.last * self.factors + self.default
        targets[:, self.wheels] -= self.default[self.wheels]
        return np.concatenate((seen, observed), 1), self.last, targets


class Tron2(Limx):
    """``WheelfootController`` of tron2_rl_deploy_ros at 699bb50."""

    def __init__(self, source: Path, policy: Path) -> None:
        config = yaml.safe_load((source / "params.yaml").read_text())["Tron2Cfg"]
        control, state, self.length = config["control"], config["init_state"], config["size"]["obs_history_length"]
        self.scales, self.observed = (0.25, 1.0, 0.05), np.ones(3)
        wheels = [i for i, mode in enumerate(control["joint_control_modes"]) if mode == "velocity"]
        factors = (control["action_scale_pos"], control["action_scale_vel"])
        self.prepare(policy, state["joint_names"], wheels, state["default_joint_angle"], factors)


class M20(RlSar):
    """``M20PolicyRunner`` of DeepRoboticsLab/sdk_deploy at 53f01d1."""

    def __init__(self, _: Path, policy: Path) -> None:
        legs = [f"{leg}_{part}_joint" for leg in ("fl", "fr", "hl", "hr") for part in ("hipx", "hipy", "knee")]
        self.joints = legs + [f"{leg}_wheel_joint" for leg in ("fl", "fr", "hl", "hr")]
        self.default = np.array([0, -0.6, 1.0] * 2 + [0, 0.6, -1.0] * 2 + [0] * 4)
        self.scale = np.array([0.125, 0.25, 0.25] * 4 + [5] * 4)
        self.last, self.policy = np.zeros((ENVS, 16)), _session(policy)

    def step(self, read: Mapping[str, Array]) -> tuple[Array, Array, Array]:  # noqa: D102
        angles = read["q"].copy()
        angles[:, 12:] = 0.0
        parts = (read["gyro"] * 0.25, gravity(read["quat"]), read["command"], angles - self.default)
        seen = np.concatenate((*parts, read["dq"] * 0.05, self.last), 1)
        self.last = np.array([_run(self.policy, row[None]) for row in seen])
        return seen, self.last, self.last * self.scale + self.default


class Upkie(RlSar):
    """``get_inputs`` and the loop of sim.py in MarcDcls/mjlab_upkie at 4d19c49."""

    def __init__(self, _: Path, policy: Path) -> None:
        self.joints = ["left_hip", "left_knee", "right_hip", "right_knee", "left_wheel", "right_wheel"]
        self.last, self.policy = np.zeros((ENVS, 6)), _session(policy)

    def step(self, read: Mapping[str, Array]) -> tuple[Array, Array, Array]:  # noqa: D102
        quat = np.where(read["quat"][:, :1] < 0, -read["quat"], read["quat"])
        seen = np.concatenate((read["q"][:, :4], read["dq"][:, 4:], quat, read["gyro"], self.last, read["command"]), 1)
        self.last = np.array([_run(self.policy, row[None]) for row in seen])
        return seen, self.last, self.last * np.array([1, 1, 1, 1, 100, 100])


_CLIP = (-100.0, 100.0)


def _session(file: Path) -> Any:
    import onnxruntime

    return onnxruntime.InferenceSession(file)


def _run(session: Any, row: Array) -> Array:
    return np.asarray(session.run(None, {session.get_inputs()[0].name: row.astype(np.float32)})[0], float).ravel()


def differences(env: ManagerBasedRLEnv, policy: Callable[[Any], torch.Tensor], runner: RlSar) -> dict[str, float]:
    """Return the largest differences of observations, actions, and targets between an environment and a runner.

    A difference of numbers above 1 is relative to the runner's number.
    """
    found = dict.fromkeys(("observations", "actions", "targets"), 0.0)
    robot, generator = env.scene.robot, torch.Generator().manual_seed(0)
    data, order = robot.data, [robot.joint_names.index(name) for name in runner.joints]
    seen, _ = env.reset()
    runner.reset(np.ones(ENVS, dtype=bool))

    def compare(what: str, mine: torch.Tensor, authors: Array) -> None:
        error = np.abs(mine.numpy().astype(float) - authors) / np.maximum(1.0, np.abs(authors))
        found[what] = max(found[what], float(error.max(initial=0.0)))

    for _ in range(STEPS):
        states = {"quat": data.root_quat_w, "gyro": data.root_ang_vel_b}
        states |= {"q": data.joint_pos[:, order], "dq": data.joint_vel[:, order]}
        states["command"] = env.command_manager.get_command("base_velocity")
        observed, wanted, targets = runner.step({name: value.double().numpy() for name, value in states.items()})
        mine = seen["policy"].clone()
        if isinstance(runner, Limx):  # Here the command is a part of each observation in the history.
            frames = mine.reshape(ENVS, len(runner.history), -1)
            mine = torch.cat((frames[:, :, :-3].flatten(1), frames[:, -1, -3:]), 1)
        compare("observations", mine, observed)
        actions = policy(seen)
        compare("actions", actions, wanted)
        runner.last = actions.double().numpy()  # so that rounding does not accumulate
        speeds = data.joint_vel + torch.randn(data.joint_vel.shape, generator=generator)  # so that states differ
        robot.write_joint_velocity_to_sim(speeds)
        seen, _, fell, late, _ = env.step(actions)
        done = (fell | late).numpy()
        made = torch.zeros(ENVS, len(order))
        for name in env.action_manager.active_terms:
            term: Any = env.action_manager.get_term(name)
            made[:, [runner.joints.index(joint) for joint in term.joint_names]] = term.processed_actions
        compare("targets", made[torch.tensor(~done)], targets[~done])
        runner.reset(done)
    return found


def load(project: Path, *words: str) -> tuple[ManagerBasedRLEnv, Callable[[Any], torch.Tensor]]:
    """Return the environment and the policy of an imported project."""
    composed = compose([f"task={project.name}", f"env.num_envs={ENVS}", *words], config_dirs=[project / "configs"])
    env = build_env(composed.config, composed.asset_roots)
    known = {field.name for field in fields(Agent)}
    agent = read_section(Agent, {k: v for k, v in composed.config["agent"].items() if k in known}, "agent")
    network = load_policy(project / "imported_policy.pt", RslRlVecEnv(env, agent.clip_actions), agent)
    clip = float("inf") if agent.clip_actions is None else agent.clip_actions
    return env, lambda seen: network(TensorDict(seen, batch_size=[ENVS])).detach().clamp(-clip, clip)


def runner_of(source: Path, policy: Path) -> RlSar:
    """Return the runner of the author of a policy."""
    others = {"m20": M20, "upkie": Upkie, "WF_TRON2A": Tron2}
    kind = others.get(source.name, Limx if (source / "params.yaml").is_file() else RlSar)
    return kind(source, policy)


if __name__ == "__main__":
    project, source, policy = (Path(word).resolve() for word in sys.argv[1:])
    env, network = load(project)
    print(differences(env, network, runner_of(source, policy)))  # noqa: T201
