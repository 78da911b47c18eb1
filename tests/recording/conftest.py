from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
import torch
from env.composed import composed

from wheelleg_exp.asset.conversion_cache import convert_cached
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.paths import find_asset
from wheelleg_exp.recording.writing.recorder import Recorder

STEPS = 90
MakeEnv = Callable[..., ManagerBasedRLEnv]


@pytest.fixture(autouse=True, scope="session")
def _strict() -> Iterator[None]:
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.fixture(scope="session")
def mjcf(tmp_path_factory) -> Path:
    source = find_asset("wheelleg/wheelleg.usda")
    return convert_cached(source, cache_dir=tmp_path_factory.mktemp("cache")).output


@pytest.fixture(scope="session")
def make_env(mjcf) -> MakeEnv:
    def make(*overrides: str, num_envs: int = 4) -> ManagerBasedRLEnv:
        command = "env.commands.base_velocity"
        walking = [f"{command}.ranges.lin_vel_x=[0.1,0.3]", f"{command}.rel_standing_envs=0.0"]
        pushes = "env.events.push_robot.interval_range_s=[0.3,0.5]"
        config = composed("task=stand", f"env.num_envs={num_envs}", *walking, pushes, *overrides).config
        return ManagerBasedRLEnv(config["env"], mjcf, seed=0)

    return make


@dataclass
class Account:
    env_id: int
    rows: dict[str, list[np.ndarray]] = field(default_factory=dict)
    ended: list[tuple[int, list[str], float]] = field(default_factory=list)
    pushed: list[int] = field(default_factory=list)
    returned: list[torch.Tensor] = field(default_factory=list)

    def __getitem__(self, name: str) -> np.ndarray:
        return np.stack(self.rows[name])

    def note(self, env: ManagerBasedRLEnv, observed: dict[str, torch.Tensor], action: torch.Tensor) -> None:
        data, i = env.scene.robot.data, self.env_id
        seen = {
            "height": data.root_pos_w[i, 2:3],
            "gravity": data.projected_gravity_b[i],
            "position": data.root_pos_w[i],
            "quaternion": data.root_quat_w[i],
            "lin_vel": data.root_lin_vel_b[i],
            "joint_pos": data.joint_pos[i],
            "joint_vel_target": data.joint_vel_target[i],
            "effort": data.applied_torque[i],
            "command": env.command_manager.get_command("base_velocity")[i],
            "forces": env.scene["contact_forces"].data.net_forces_w[i],
            "rewards": env.reward_manager.step_reward[:, i],
            "policy": observed["policy"][i],
            "critic": observed["critic"][i],
            "action": action[i],
            "qpos": env.scene.sim.view("qpos")[i],
        }
        for name, value in seen.items():
            self.rows.setdefault(name, []).append(value.clone().numpy())
        manager = env.termination_manager
        if manager.dones[i]:
            fired = [name for name in manager.active_terms if manager.get_term(name)[i]]
            self.ended.append((env.common_step_counter, fired, env.episode_length_buf[i].item() * env.step_dt))


def roll_out(env: ManagerBasedRLEnv, account: Account, steps: int = STEPS) -> Account:
    generator = torch.Generator().manual_seed(7)
    observed, _ = env.reset(seed=3)
    action = torch.zeros(env.num_envs, env.action_manager.total_action_dim)
    env.observers.append(lambda: account.note(env, observed, action))
    with torch.inference_mode():
        for _ in range(steps):
            action = 0.3 * torch.randn(action.shape, generator=generator)
            observed, reward, *_ = env.step(action)
            if env.event_manager.fired["push_robot"][account.env_id]:
                account.pushed.append(env.common_step_counter)
            account.returned += [observed["critic"].clone(), reward.clone(), env.scene.sim.state.clone()]
    env.observers.pop()
    return account


def record(
    path: Path, env: ManagerBasedRLEnv, env_ids: tuple[int, ...] = (1,), steps: int = STEPS, **options: object
) -> Account:
    arguments: dict = {"recording_id": "r", "name": "n", "purpose": "play", **options}
    with Recorder(path, env, env_ids=env_ids, **arguments) as recorder:
        env.observers.append(recorder.capture)
        recorder.start()
        return roll_out(env, Account(env_ids[0]), steps)


@pytest.fixture(scope="session")
def recorded(make_env, tmp_path_factory) -> tuple[Path, Account, ManagerBasedRLEnv]:
    path, env = tmp_path_factory.mktemp("recorded") / "recording.rrd", make_env()
    return path, record(path, env), env
