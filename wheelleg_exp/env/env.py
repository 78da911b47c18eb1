"""The environment: the order of one step and of one reset."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import (
    ActionManager,
    CommandManager,
    CurriculumManager,
    EventManager,
    ObservationManager,
    RewardManager,
    SceneManager,
    TerminationManager,
)
from wheelleg_exp.managers.observation_manager import Group
from wheelleg_exp.managers.streams import Streams
from wheelleg_exp.sim.state import Kept, cloned

Observations = dict[str, Group]
StepResult = tuple[Observations, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]


class ManagerBasedRLEnv(Kept):
    """N environments under eight managers, after Isaac Lab's ``ManagerBasedRLEnv``.

    Args:
        cfg: the composed ``env`` section, plain.
        mjcf: the robot's MJCF file.
        seed: seed of every random stream.

    Attributes:
        auto_reset: whether an environment that is done is reset within the step.
        keep_final_obs: whether ``extras["final_obs"]`` holds the last observation of the episodes that end.
        observers: called in every step after the rewards and before the resets.

    Raises:
        ConfigError: something in ``cfg`` is wrong.
    """

    def __init__(self, cfg: Mapping[str, Any], mjcf: Path, seed: int) -> None:
        self.cfg = cfg
        self.seed = seed
        self.num_envs = _positive_int(cfg, "num_envs")
        self.decimation = _positive_int(cfg, "decimation")
        self.physics_dt = _positive(_section(cfg, "sim"), "dt", "env.sim.dt")
        self.step_dt = self.physics_dt * self.decimation
        self.max_episode_length_s = _positive(cfg, "episode_length_s", "env.episode_length_s")
        # Rounded first, because 5 s / (2 / 120 s) must be 300 steps and not 301.
        self.max_episode_length = math.ceil(round(self.max_episode_length_s / self.step_dt, 9))
        self.common_step_counter = 0
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long)
        self.streams = Streams(seed)
        self.extras: dict[str, Any] = {}
        self.keep_final_obs = False
        self.auto_reset = True
        self.observers: list[Callable[[], None]] = []

        self.scene_manager = SceneManager(cfg, mjcf, self.num_envs)
        self.scene = self.scene_manager.scene
        self.event_manager = EventManager(cfg.get("events"), self)
        self.event_manager.apply("prestartup")
        self.scene.play()
        self.event_manager.play()
        self.command_manager = CommandManager(cfg.get("commands"), self)
        self.action_manager = ActionManager(cfg.get("actions"), self)
        self.observation_manager = ObservationManager(_section(cfg, "observations"), self)
        self.termination_manager = TerminationManager(cfg.get("terminations"), self)
        self.reward_manager = RewardManager(cfg.get("rewards"), self)
        self.curriculum_manager = CurriculumManager(cfg.get("curriculum"), self)
        self.event_manager.apply("startup")
        self.reward_buf = torch.zeros(self.num_envs)

    @property
    def managers(self) -> dict[str, Any]:
        """The eight managers by the name of their section, in the order of construction."""
        return {
            "scene": self.scene_manager,
            "events": self.event_manager,
            "commands": self.command_manager,
            "actions": self.action_manager,
            "observations": self.observation_manager,
            "terminations": self.termination_manager,
            "rewards": self.reward_manager,
            "curriculum": self.curriculum_manager,
        }

    def step(self, action: torch.Tensor) -> StepResult:
        """Advance every environment by one control step.

        Terminations and rewards see the new state before anything is reset; an environment that is done is reset
        within the step, so that the returned observation begins its next episode. Commands and interval events
        come after the resets, as in Isaac Lab: a push shows in the observation that this step returns.

        Args:
            action: raw actions (N, total_action_dim).

        Returns:
            Observations by group, reward (N,), terminated (N,) bool, truncated (N,) bool, and extras.
        """
        self.action_manager.process_action(action)
        for _ in range(self.decimation):
            self.action_manager.apply_action()
            self.scene.write_data_to_sim()
            self.scene.sim.step()
            self.scene.update()
        self.episode_length_buf += 1
        self.common_step_counter += 1

        self.extras.pop("non_finite", None)
        done = self.termination_manager.compute()
        self.reward_buf = self.reward_manager.compute(self.step_dt)
        if self.reward_manager.non_finite:
            done = self._end_non_finite()
        for observe in self.observers:
            observe()

        self.extras["log_is_fresh"] = False
        self.extras.pop("final_obs", None)
        if self.auto_reset and done.any():
            if self.keep_final_obs:
                self.extras["final_obs"] = self.observation_manager.peek()
            self._reset_idx(done.nonzero().squeeze(1))
        self.command_manager.compute(self.step_dt)
        self.event_manager.apply_interval(self.step_dt)
        self.scene.refresh()
        observations = self.observation_manager.compute()
        terminated, time_outs = self.termination_manager.terminated, self.termination_manager.time_outs
        return observations, self.reward_buf, terminated.clone(), time_outs.clone(), self.extras

    def reset(
        self, seed: int | None = None, env_ids: torch.Tensor | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Reset environments and return the observations of all.

        Commands are drawn but not post-processed here: the first observation shows the drawn command of an
        environment that is to stand still, as in Isaac Lab.

        Args:
            seed: starts every random stream anew.
            env_ids: environments, or None for all.
        """
        if seed is not None:
            self.seed = seed
            self.streams.reseed(seed)
        ids = torch.arange(self.num_envs) if env_ids is None else torch.unique(env_ids)
        if len(ids):
            self._reset_idx(ids)
        self.scene.refresh()
        return self.observation_manager.compute(), self.extras

    def _reset_idx(self, env_ids: torch.Tensor) -> None:
        """Reset ``env_ids``: the curriculum sees the terminal state, events set the new one, then the records."""
        self.curriculum_manager.compute(env_ids)
        log: dict[str, Any] = {**self.scene.diagnostics(env_ids)}
        self.scene.reset(env_ids)
        self.event_manager.apply("reset", env_ids, self.common_step_counter)
        for manager in (
            self.observation_manager,
            self.action_manager,
            self.reward_manager,
            self.curriculum_manager,
            self.command_manager,
            self.event_manager,
            self.termination_manager,
        ):
            log.update(manager.reset(env_ids))
        self.extras["log"] = log
        self.extras["log_is_fresh"] = True
        self.episode_length_buf[env_ids] = 0

    def apply_event(self, mode: str, env_ids: torch.Tensor | None = None) -> None:
        """Run the events of a mode of the caller's own, and make derived quantities fresh."""
        self.event_manager.apply(mode, env_ids, self.common_step_counter)
        self.scene.refresh()

    def _end_non_finite(self) -> torch.Tensor:
        """End the environments whose reward was not finite; name the terms and keep the state in ``extras``."""
        found = self.reward_manager.non_finite
        state = self.scene.sim.state
        self.extras["non_finite"] = {i: {"terms": terms, "state": state[i].clone()} for i, terms in found.items()}
        return self.termination_manager.force(torch.tensor(list(found)))

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the coming steps depend on."""
        return {
            "seed": self.seed,
            "common_step_counter": self.common_step_counter,
            "episode_length_buf": self.episode_length_buf.clone(),
            "reward_buf": self.reward_buf.clone(),
            "extras": cloned(self.extras),
            "streams": self.streams.state_dict(),
            "scene": self.scene.state_dict(),
            "managers": {n: m.state_dict() for n, m in self.managers.items() if n != "scene"},
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned, in an environment built from the same config."""
        self.seed = saved["seed"]
        self.common_step_counter = saved["common_step_counter"]
        self.episode_length_buf.copy_(saved["episode_length_buf"])
        self.reward_buf = saved["reward_buf"].clone()
        self.extras = cloned(saved["extras"])
        self.scene.load_state_dict(saved["scene"])
        for name, state in saved["managers"].items():
            self.managers[name].load_state_dict(state)
        self.streams.load_state_dict(saved["streams"])

    def describe(self) -> str:
        """Return a table for each manager: its terms, shapes, weights."""
        return "\n\n".join(str(manager) for manager in self.managers.values())


def _positive_int(cfg: Mapping[str, Any], key: str) -> int:
    value = cfg.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ConfigError(f"is {value!r}", key=f"env.{key}", expected="a whole number of at least 1")
    return value


def _positive(cfg: Mapping[str, Any], key: str, path: str) -> float:
    value = cfg.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.0 < value < math.inf:
        raise ConfigError(f"is {value!r}", key=path, expected="seconds, above 0")
    return float(value)


def _section(cfg: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = cfg.get(key)
    if not isinstance(value, Mapping):
        raise ConfigError("the section is missing", key=f"env.{key}", expected="a mapping")
    return value
