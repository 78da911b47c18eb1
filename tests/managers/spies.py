"""Terms that log their calls, return values set by a test, or have unusual state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import torch

from wheelleg_exp.constraints import NonNegative
from wheelleg_exp.managers import ActionTerm, CommandTerm, Env, RecorderTerm, SceneEntityCfg, TermBase
from wheelleg_exp.sim.actuators import IdealPDActuator, ImplicitActuator
from wheelleg_exp.sim.robot_model import JointTargets
from wheelleg_exp.sim.sensors import SensorBase
from wheelleg_exp.sim.terrain import TerrainBase
from wheelleg_exp.state import Stateful

LOG: list[Any] = []
VALUES: dict[str, Any] = {}

HERE = "managers.spies."


def clear() -> None:
    LOG.clear()
    VALUES.clear()


def value(env: Env, key: str) -> torch.Tensor:
    """Return ``VALUES[key]``, or its result for a function, with one row for each environment."""
    found = VALUES[key]
    if callable(found):
        found = found(env)
    return found if isinstance(found, torch.Tensor) else _each(env, found)


def column(env: Env, key: str) -> torch.Tensor:
    return value(env, key).unsqueeze(1)


def flag(env: Env, key: str) -> torch.Tensor:
    return value(env, key).bool()


def writes(env: Env, env_ids: torch.Tensor | None, key: str) -> None:
    VALUES[key](env, torch.arange(env.num_envs) if env_ids is None else env_ids)


def noted(env: Env, env_ids: torch.Tensor | None, key: str = "event") -> None:
    LOG.append((key, env.common_step_counter, None if env_ids is None else env_ids.tolist()))


def drawing_observation(env: Env, generator: torch.Generator) -> torch.Tensor:
    return torch.rand(env.num_envs, 1, generator=generator)


def state_of(env: Env, env_ids: torch.Tensor, key: str) -> Any:
    return VALUES[key]


class CountingObservation(TermBase):
    def __init__(self, env: Env) -> None:
        self.count = torch.zeros(env.num_envs, 1)

    def __call__(self, env: Env) -> torch.Tensor:
        self.count += 1
        return self.count.clone()

    def reset(self, env_ids: torch.Tensor) -> None:
        self.count[env_ids] = 0.0


class Spy(TermBase):
    kind = "?"

    def __init__(self, env: Env) -> None:
        self._env = env
        LOG.append(f"{self.kind} made")

    def reset(self, env_ids: torch.Tensor) -> None:
        LOG.append(f"{self.kind} reset {env_ids.tolist()}")


class SpyObservation(Spy):
    kind = "observation"

    def __call__(self, env: Env) -> torch.Tensor:
        LOG.append("observation")
        return torch.zeros(env.num_envs, 1)


class SpyRecorder(Spy, RecorderTerm):
    kind = "recorder"


def _record(hook: str) -> Callable[..., tuple[None, None]]:
    def record(self: SpyRecorder, *env_ids: torch.Tensor) -> tuple[None, None]:
        LOG.append(" ".join([f"recorder {hook}", *(str(ids.tolist()) for ids in env_ids)]))
        return None, None

    return record


for _hook in ("pre_step", "post_physics_decimation_step", "post_step", "pre_reset", "post_reset"):
    setattr(SpyRecorder, f"record_{_hook}", _record(_hook.removesuffix("_decimation_step")))


class SpyTermination(Spy):
    kind = "termination"

    def __call__(self, env: Env) -> torch.Tensor:
        LOG.append("termination")
        return VALUES.get("done", torch.zeros(env.num_envs)).bool()


class SpyReward(Spy):
    kind = "reward"

    def __call__(self, env: Env) -> torch.Tensor:
        LOG.append("reward")
        return torch.zeros(env.num_envs)


class SpyCurriculum(Spy):
    kind = "curriculum"

    def __call__(self, env: Env, env_ids: torch.Tensor) -> None:
        LOG.append(f"curriculum {env_ids.tolist()} at length {env.episode_length_buf[env_ids].tolist()}")


class SpyEvent(Spy):
    kind = "event"

    def __init__(self, env: Env, name: str) -> None:
        self.kind = f"event {name}"
        super().__init__(env)

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        LOG.append(f"{self.kind} {None if env_ids is None else env_ids.tolist()}")


def default_entity(env: Env, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot", joint_names=["left_hip"])):  # noqa: B008
    LOG.append(asset_cfg.joint_ids)
    return torch.zeros(env.num_envs)


def spy_prestartup(env: Env, env_ids: torch.Tensor | None) -> None:
    LOG.append(f"event prestartup {env_ids}, compiled: {hasattr(env.scene, 'sim')}")


class SpyCommand(CommandTerm):
    def __init__(self, env: Env, generator: torch.Generator) -> None:
        super().__init__(env, (100.0, 100.0), (), generator)
        LOG.append("command made")

    @property
    def command(self) -> torch.Tensor:
        return torch.zeros(self._env.num_envs, 1)

    def errors(self) -> torch.Tensor:
        LOG.append("command compute")
        return torch.zeros(0, self._env.num_envs)

    def draw(self, env_ids: torch.Tensor) -> None:
        LOG.append(f"command draw {env_ids.tolist()}")


class SpyAction(ActionTerm):
    def __init__(self, env: Env) -> None:
        self.action_dim = 1
        self.raw_actions = torch.zeros(env.num_envs, 1)
        self.processed_actions = torch.zeros(env.num_envs, 1)
        LOG.append("action made")

    def process_actions(self, actions: torch.Tensor) -> None:
        LOG.append("action process")

    def apply_actions(self) -> None:
        LOG.append("action apply")

    def reset(self, env_ids: torch.Tensor) -> None:
        LOG.append(f"action reset {env_ids.tolist()}")


def _each(env: Env, number: float) -> torch.Tensor:
    return torch.full((env.num_envs,), float(number))


class RemembersInAList(TermBase):
    def __init__(self, env: Env) -> None:
        self._calls: list[float] = []
        self._seen: dict[str, Any] = {"most": 0.0, "rows": np.zeros(env.num_envs)}
        self._last: list[float] = []

    def __call__(self, env: Env) -> torch.Tensor:
        height = env.scene.robot.data.root_pos_w[:, 2]
        self._calls.append(float(height.mean()))
        self._last = [*self._last[-2:], float(height[0])]
        self._seen["most"] = max(self._seen["most"], self._calls[-1])
        self._seen["rows"] += height.numpy()
        total = sum(self._calls) + self._seen["most"] + sum(self._last)
        return torch.from_numpy(self._seen["rows"]).float() + total


class RemembersNumbers(TermBase):
    def __init__(self, env: Env) -> None:
        self._count, self._sum = 0, None
        self._mode = ("a", 1)

    def __call__(self, env: Env) -> torch.Tensor:
        self._count += 1
        speed = env.scene.robot.data.root_lin_vel_w[:, 0]
        self._sum = speed.clone() if self._sum is None else self._sum + speed
        self._mode = ("b", self._count)
        return self._sum + self._count * self._mode[1]


class _Helper(Stateful):
    def __init__(self) -> None:
        self.total, self.kept = 0.0, [torch.zeros(1)]
        self.scale = lambda x: 2.0 * x

    def add(self, value: float) -> float:
        self.total += value
        self.kept[0] += value
        return self.scale(self.total) + float(self.kept[0])


class RemembersInAHelper(TermBase):
    def __init__(self, env: Env) -> None:
        self._env = env
        self._helper = _Helper()
        self._norm = torch.nn.BatchNorm1d(1, affine=False)

    def __call__(self, env: Env) -> torch.Tensor:
        height = self._env.scene.robot.data.root_pos_w[:, 2:3]
        with torch.no_grad():
            normal = self._norm(height)[:, 0]
        return normal + self._helper.add(float(height.mean()))


class RemembersGenerators(TermBase):
    def __init__(self, env: Env) -> None:
        self._torch, self._others = torch.Generator().manual_seed(1), [torch.Generator().manual_seed(2)]

    def __call__(self, env: Env) -> torch.Tensor:
        return sum(torch.rand(env.num_envs, generator=generator) for generator in (self._torch, *self._others))


class RemembersLate(TermBase):
    def __init__(self, env: Env) -> None:
        pass

    def __call__(self, env: Env) -> torch.Tensor:
        return _count_on(self, env)


def remembers_on_the_environment(env: Any) -> torch.Tensor:
    if not hasattr(env, "own_calls"):
        env.own_calls, env.own_heights = 0, torch.zeros(env.num_envs)
    env.own_calls += 1
    env.own_heights += env.scene.robot.data.root_pos_w[:, 2]
    return env.own_heights + env.own_calls


def _count_on(holder: Any, env: Env, name: str = "calls") -> torch.Tensor:
    """Count the calls in an attribute of an object."""
    setattr(holder, name, getattr(holder, name, 0) + 1)
    return _each(env, getattr(holder, name))


def remembers_on_the_robot(env: Env) -> torch.Tensor:
    return _count_on(env.scene.robot, env, "own_calls")


def remembers_on_its_term(env: Any) -> torch.Tensor:
    return _count_on(env.reward_manager.get_term_cfg("own"), env)


def expands_the_batch(env: Any) -> torch.Tensor:
    env.scene.sim.batch.expand("jnt_stiffness")[:] += 1.0
    return torch.zeros(env.num_envs)


class Delayed(ImplicitActuator):
    def connect(self, num_envs: int, dt: float, stream: Any) -> None:
        super().connect(num_envs, dt, stream)
        self._waiting: list[torch.Tensor] = self.number("_waiting", [])
        self.heat = self.buffer("heat", torch.zeros(1))

    def control(self, targets: Any, data: Any) -> torch.Tensor:
        self._waiting = [*self._waiting[-1:], super().control(targets, data).clone()]
        self.heat += self._waiting[-1].abs().mean()
        return self._waiting[0] * torch.exp(-self.heat / 100.0)


class Late(IdealPDActuator):
    def connect(self, num_envs: int, dt: float, stream: Any) -> None:
        super().connect(num_envs, dt, stream)
        self.dt, self.past = dt, torch.zeros(num_envs, 2, len(self.joint_names))
        self.offset = torch.rand(num_envs, len(self.joint_names), generator=stream())

    def reset(self, env_ids: torch.Tensor) -> None:
        self.past[env_ids] = 0.0

    def control(self, targets: JointTargets, data: Any) -> torch.Tensor:
        now = targets.pos[:, self.joint_ids]
        pos = targets.pos.clone()
        pos[:, self.joint_ids] = self.past[:, 0] + self.offset
        self.past = torch.stack((self.past[:, 1], now), dim=1)
        return super().control(JointTargets(pos, targets.vel, targets.effort), data)


class Altimeter(SensorBase):
    def connect(self, sim: Any, stream: Any) -> None:
        super().connect(sim, stream)
        self._stream, self.height = stream(), torch.zeros(sim.num_envs)
        self.measured = torch.zeros(sim.num_envs)

    def measure(self, due: torch.Tensor | None, elapsed: Any) -> None:
        noise = torch.randn(len(self.height), generator=self._stream)
        due = torch.ones_like(self.measured, dtype=torch.bool) if due is None else due
        self.height = torch.where(due, self._sim.view("qpos")[:, 2].float() + 1e-3 * noise, self.height)
        self.measured += due

    def reset(self, env_ids: torch.Tensor) -> None:
        super().reset(env_ids)
        self.height[env_ids] = 0.0
        self.measured[env_ids] = 0.0

    def refresh(self, env_ids: torch.Tensor) -> None:
        self.height[env_ids] = self._sim.view("qpos")[env_ids, 2].float()

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "height": self.height.clone(), "measured": self.measured.clone()}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        super().load_state_dict(saved)
        self.height.copy_(saved["height"])
        self.measured.copy_(saved["measured"])


class Step(TerrainBase):
    def __init__(
        self, height: float, static_friction: NonNegative, dynamic_friction: NonNegative, restitution: float
    ) -> None:
        super().__init__(static_friction, dynamic_friction, restitution)
        self.height = height

    def add_to(self, spec: mujoco.MjSpec) -> None:
        kind = mujoco.mjtGeom
        spec.worldbody.add_geom(name="ground", type=kind.mjGEOM_PLANE, size=[0, 0, 0.1])
        half = self.height / 2
        spec.worldbody.add_geom(name="ground/step", type=kind.mjGEOM_BOX, size=[1, 1, half], pos=[5, 0, half])

    def origins(self, num_envs: int, spacing: float, device: torch.device) -> torch.Tensor:
        high = torch.tensor([5.0, 0.0, self.height], device=device)
        return torch.where(torch.arange(num_envs).unsqueeze(1) % 2 == 0, high, torch.zeros(3))


class KeepsMasses(TermBase):
    def __init__(self, env: Env) -> None:
        self._masses = (env.scene.sim.expand("body_mass"),)

    def __call__(self, env: Env, env_ids: torch.Tensor) -> None:
        self._masses[0][env_ids] = VALUES.get("mass", 1.0)
