"""The environment: the order of one step and of one reset."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import torch

from wheelleg_exp.env.captured import Memory
from wheelleg_exp.env.captured_step import CapturedReset, CapturedStep, captured_commands, captured_look
from wheelleg_exp.env.isaaclab_attributes import Cfg, IsaacLabAttributes
from wheelleg_exp.env.state_elsewhere import TermState
from wheelleg_exp.machine import require_memory
from wheelleg_exp.managers import (
    ActionManager,
    CommandManager,
    CurriculumManager,
    EventManager,
    ObservationManager,
    RecorderManager,
    RewardManager,
    SceneManager,
    TerminationManager,
)
from wheelleg_exp.managers.async_queries import AsyncMaskQuery
from wheelleg_exp.managers.non_finite import failures, require_finite_observations
from wheelleg_exp.managers.observation_manager import Group
from wheelleg_exp.managers.streams import Streams
from wheelleg_exp.sim.ids import ids_where
from wheelleg_exp.sim.options import SimOptions
from wheelleg_exp.sim.timers import forget
from wheelleg_exp.sim.warp_runtime import require_device
from wheelleg_exp.state import cloned, on_device
from wheelleg_exp.terms.config_sections import Dataset, Env, read_section, read_value

_LEAST_PER_ENV = 10_000  # bytes: state, outputs and observations of one small robot

Observations = dict[str, Group]
AutoresetMode = Literal["same_step", "next_step", "disabled"]
StepResult = tuple[Observations, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]


class ManagerBasedRLEnv(IsaacLabAttributes):
    """N environments under nine managers, after Isaac Lab's ``ManagerBasedRLEnv``.

    Args:
        cfg: the composed ``env`` section, plain.
        mjcf: the robot's MJCF file.
        seed: seed of every random stream.

    Attributes:
        device: where all tensors are; nobody else says so.
        autoreset: when an environment that is done is reset: within the step; in the next, which counts for nothing;
            or by the caller.
        keep_final_obs: whether ``extras["final_obs"]`` holds the last observation of the episodes that end.
        observers: called in every step after the rewards and before the resets.

    Raises:
        ConfigError: something in ``cfg`` is wrong.
    """

    def __init__(self, cfg: Mapping[str, Any], mjcf: Path, seed: int) -> None:
        self.cfg = Cfg(cfg)
        self.seed = seed
        self.num_envs: int = read_value(Env, cfg, "env", "num_envs")
        require_memory(_LEAST_PER_ENV * self.num_envs, "env.num_envs", f"{self.num_envs:,} environments")
        self.decimation: int = read_value(Env, cfg, "env", "decimation")
        sim = read_value(Env, cfg, "env", "sim")
        self.device = torch.device(read_value(SimOptions, sim, "env.sim", "device"))
        require_device(self.device)
        self.physics_dt = float(read_value(SimOptions, sim, "env.sim", "dt"))
        self.step_dt = self.physics_dt * self.decimation
        self.max_episode_length_s = float(read_value(Env, cfg, "env", "episode_length_s"))
        # Rounded first, because 5 s / (2 / 120 s) must be 300 steps and not 301.
        self.max_episode_length = math.ceil(round(self.max_episode_length_s / self.step_dt, 9))
        self.common_step_counter = 0
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self.streams = Streams(seed, self.device)
        self.extras: dict[str, Any] = {}
        self.keep_final_obs = False
        self.autoreset: AutoresetMode = "same_step"
        self.observers: list[Callable[[], None]] = []

        self.scene_manager = SceneManager(cfg, mjcf, self.num_envs, self.streams.get)
        self.scene = self.scene_manager.scene
        self.event_manager = EventManager(cfg.get("events"), self)
        self.event_manager.apply("prestartup")
        self.scene.play()
        self.event_manager.play()
        self.command_manager = CommandManager(cfg.get("commands"), self)
        dataset = read_section(Dataset, cfg.get("dataset") or {}, "env.dataset")
        self.recorder_manager = RecorderManager(cfg.get("recorders"), dataset, self)
        self.action_manager = ActionManager(cfg.get("actions"), self)
        self.observation_manager = ObservationManager(read_value(Env, cfg, "env", "observations"), self)
        self.termination_manager = TerminationManager(cfg.get("terminations"), self)
        self.reward_manager = RewardManager(cfg.get("rewards"), self)
        self.curriculum_manager = CurriculumManager(cfg.get("curriculum"), self)
        self.event_manager.apply("startup")
        self.reward_buf = torch.zeros(self.num_envs, device=self.device)
        self._no_ids = torch.zeros(0, dtype=torch.long, device=self.device)
        self._action = torch.zeros(self.num_envs, self.action_manager.total_action_dim, device=self.device)
        self._asked = AsyncMaskQuery(self.num_envs, self.device)
        self._captured_memory = Memory(is_told=True)
        self._sensors_refresh = any(sensor.refreshes for sensor in self.scene.sensors.values())
        self._captured = CapturedStep(self) if self.scene.sim.is_captured else None
        self._captured_look = captured_look(self) if self.scene.sim.is_captured else None
        self._captured_reset = CapturedReset(self) if self.scene.sim.is_captured else None
        self._captured_commands = captured_commands(self) if self.scene.sim.is_captured else None
        self._term_state = TermState(self, self.managers, cfg)

    @property
    def managers(self) -> dict[str, Any]:
        """The nine managers by the name of their section, in the order of construction."""
        return {
            "scene": self.scene_manager,
            "events": self.event_manager,
            "commands": self.command_manager,
            "recorders": self.recorder_manager,
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
            Observations by group, reward (N,), terminated (N,) bool, truncated (N,) bool, and extras. An environment
            whose physics or rewards were not finite has failed, and this step's reward is 0: ``extras["non_finite"]``.

        Raises:
            SimulationFailure: observations, or what an event wrote, are not finite: the run cannot go on.
        """
        self._captured_memory.is_seen = False  # who calls may have changed settings
        waiting, watched = self._waiting(), self._is_watched()
        self._asked.begin(*self._simulate(action, waiting))  # which have ended: a GPU has the rewards to do meanwhile
        ended, broken = self._asked.ids(self._reward(waiting), at_once=watched)
        self.extras.pop("non_finite", None)
        if len(ended):
            self._end_failed(broken)
        for observe in self.observers:
            observe()
        self.recorder_manager.record_post_step()

        self.extras["log_is_fresh"] = False
        self.extras.pop("final_obs", None)
        if self.autoreset != "same_step":
            ended = self._no_ids if waiting is None else ids_where(waiting)
        if len(ended):
            if self.keep_final_obs:
                self.extras["final_obs"] = self.observation_manager.peek()
            self.recorder_manager.record_pre_reset(ended)
            self._reset_idx(ended)
            self.recorder_manager.record_post_reset(ended)
        self._end_late(*self._asked.late())
        self._captured_memory.is_seen &= not watched
        self._command()
        if self.event_manager.apply_due(self.step_dt) or self._sensors_refresh:
            self._captured_memory.is_seen = False
        self.scene.show_written()
        observations = self._observe()
        if self.autoreset == "same_step":  # else those that have failed still show it
            require_finite_observations(self, is_noted=self._captured_look is not None)
        terminated, time_outs = self.termination_manager.terminated, self.termination_manager.time_outs
        reward = self.reward_buf if self._captured is None else self.reward_buf.clone()
        return observations, reward, terminated.clone(), time_outs.clone(), self.extras

    def _graphs(self, waiting: torch.Tensor | None) -> CapturedStep | None:
        """Return what does this step, where it is captured."""
        return self._captured if waiting is None and not self.recorder_manager.active_terms else None

    def _is_watched(self) -> bool:
        """Return whether all that end have to be known before anything is reset."""
        lookers = self.observers or self.recorder_manager.active_terms
        return self._captured is None or bool(lookers) or self.keep_final_obs or self.autoreset != "same_step"

    def _simulate(self, action: torch.Tensor, waiting: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
        """Act, simulate and judge: return which environments have ended, and whose physics has failed, (N,) bool."""
        graphs = self._graphs(waiting)
        if graphs is None:
            return self._act_and_judge(action, waiting)
        count = self.common_step_counter
        self._action.copy_(action)
        ended, failed = graphs()
        self.common_step_counter = count + 1
        return ended, failed

    def _act_and_judge(self, action: torch.Tensor, waiting: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
        self._act(action)
        for substep in range(self.decimation):
            if substep:
                self._act_again()
            self.scene.sim.step()
        return self._judge(waiting)

    def _act(self, action: torch.Tensor) -> None:
        """Take up an action, and write what the first physics step begins with."""
        self.action_manager.process_action(action)
        self.recorder_manager.record_pre_step()
        self.scene.robot.begin_control_step()
        self.action_manager.apply_action()
        self.scene.write_data_to_sim()

    def _act_again(self) -> None:
        """Take up a physics step that has run, and write what the next one begins with."""
        self.recorder_manager.record_post_physics_decimation_step()
        self.scene.update()
        self.observation_manager.sample_between()
        self.action_manager.apply_action()
        self.scene.write_data_to_sim()

    def _judge(self, waiting: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
        """Take up the last physics step, and judge: which environments have ended, and whose physics has failed."""
        self.recorder_manager.record_post_physics_decimation_step()
        self.scene.update()
        self.episode_length_buf += 1
        self.common_step_counter += 1
        done, failed = self.termination_manager.compute(waiting), self.scene.unstable()
        if waiting is not None:
            failed = failed & ~waiting
        return done | failed, failed

    def _reward(self, waiting: torch.Tensor | None) -> torch.Tensor:
        """Work out the rewards: return whose are not finite, (N,) bool."""
        graphs = self._graphs(waiting)
        return self._work_out_rewards(waiting) if graphs is None else graphs.rewards()

    def _work_out_rewards(self, waiting: torch.Tensor | None) -> torch.Tensor:
        self.reward_buf = self.reward_manager.compute(self.step_dt, waiting)
        failed = self.reward_manager.failed
        return failed if waiting is None else failed & ~waiting

    def _command(self) -> None:
        """Advance the commands, and the timers of events."""
        if self._captured_commands is not None and not self.command_manager.may_draw(self.step_dt):
            self._captured_commands()
            return
        self.command_manager.compute(self.step_dt, draws=None if self._captured_commands is None else True)
        self._captured_memory.is_seen = False
        self.event_manager.advance_timers(self.step_dt)

    def _observe(self) -> Observations:
        """Return the observations; those of a graph are copied out of its memory."""
        if self._captured_look is None:
            return self.observation_manager.compute()
        return cloned(self._captured_look())

    def _waiting(self) -> torch.Tensor | None:
        """Return which environments ended in the last step and begin anew in this one, (N,) bool (``next_step``)."""
        if self.autoreset != "next_step":
            return None
        return self.termination_manager.dones & (self.episode_length_buf > 0)

    def reset(
        self, seed: int | None = None, env_ids: torch.Tensor | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Reset environments and return the observations of all; those of the others stay as they were.

        Commands are drawn but not post-processed here: the first observation shows the drawn command of an
        environment that is to stand still, as in Isaac Lab.

        Args:
            seed: starts every random stream anew.
            env_ids: environments, or None for all.
        """
        ids = torch.arange(self.num_envs, device=self.device) if env_ids is None else torch.unique(env_ids)
        self.recorder_manager.record_pre_reset(ids)
        if seed is not None:
            self.seed = seed
            self.streams.reseed(seed)
        if len(ids):
            self._reset_idx(ids)
        self.scene.refresh()
        self.recorder_manager.record_post_reset(ids)
        only = None
        if env_ids is not None:
            only = torch.zeros_like(self.termination_manager.dones).index_fill_(0, ids, True)
        observations = self.observation_manager.compute(only)
        require_finite_observations(self, only)
        return observations, self.extras

    def _reset_idx(self, env_ids: torch.Tensor) -> None:
        """Reset ``env_ids``: the curriculum sees the terminal state, events set the new one, then the records."""
        self.curriculum_manager.compute(env_ids)
        self._captured_memory.is_seen = False
        if self._captured_reset is None:
            log = self._reset_rows(env_ids)
        else:
            log = self._captured_reset(env_ids)
            for manager in (self.curriculum_manager, self.recorder_manager):
                log.update(manager.reset(env_ids))
            self._captured_memory.is_seen &= not self.curriculum_manager.remembers
        self.extras["log"] = log
        self.extras["log_is_fresh"] = True

    def _reset_rows(self, env_ids: torch.Tensor, host: bool = True) -> dict[str, Any]:
        """Reset simulations and managers of ``env_ids``; return what is logged.

        Args:
            env_ids: environments, (n,).
            host: whether those managers are among them whose work is the host's.
        """
        log: dict[str, Any] = {**self.scene.diagnostics(env_ids)}
        self.scene.reset(env_ids)
        self.event_manager.apply("reset", env_ids, self.common_step_counter)
        for manager in (
            self.observation_manager,
            self.action_manager,
            self.reward_manager,
            *((self.curriculum_manager,) if host else ()),
            self.command_manager,
            self.event_manager,
            self.termination_manager,
            *((self.recorder_manager,) if host else ()),
        ):
            log.update(manager.reset(env_ids))
        self.episode_length_buf.index_fill_(0, env_ids, 0)
        return log

    def apply_event(self, mode: str, env_ids: torch.Tensor | None = None) -> None:
        """Run the events of a mode of the caller's own, and make derived quantities fresh."""
        self.event_manager.apply(mode, env_ids, self.common_step_counter)
        self.scene.refresh()

    def _end_failed(self, env_ids: torch.Tensor) -> None:
        """End the episodes in which a number was not finite; tell whose it was, and keep the state, in ``extras``.

        Args:
            env_ids: environments whose physics or rewards have failed, (n,).
        """
        if len(env_ids):
            self.reward_manager.exclude(env_ids[self.reward_manager.failed[env_ids]])
            told = failures(self, env_ids)
            self.extras.setdefault("non_finite", told)["keys"].update(told["keys"])
            self.termination_manager.force(env_ids)

    def _end_late(self, failed: torch.Tensor, alone: torch.Tensor) -> None:
        """End the episodes whose rewards were found not to be finite when the others were being reset.

        Args:
            failed: environments whose rewards have failed, and not their physics, (n,).
            alone: those of them that nothing else has ended.
        """
        self._end_failed(failed)
        if len(alone):
            log = self.extras.get("log") if self.extras["log_is_fresh"] else None
            self._reset_idx(alone)
            self.extras["log"] = log or self.extras["log"]  # of those that have ended in the usual way

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the coming steps depend on.

        Raises:
            ConfigError: a term keeps state where it cannot be saved.
        """
        attributes = self._term_state.save()
        managers = {name: manager.state_dict() for name, manager in self.managers.items() if name != "scene"}
        return {
            "seed": self.seed,
            "common_step_counter": self.common_step_counter,
            "episode_length_buf": self.episode_length_buf.clone(),
            "reward_buf": self.reward_buf.clone(),
            "extras": cloned(self.extras),
            "streams": self.streams.state_dict(),
            "scene": self.scene.state_dict(),
            "managers": {name: state for name, state in managers.items() if state},  # recorders keep none of their own
            **({"attributes": attributes} if attributes else {}),
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned, in an environment built from the same config."""
        saved = {name: part if name == "streams" else on_device(part, self.device) for name, part in saved.items()}
        self.seed = saved["seed"]
        self.common_step_counter = saved["common_step_counter"]
        self.episode_length_buf.copy_(saved["episode_length_buf"])
        self.reward_buf = saved["reward_buf"].clone()
        self.extras = cloned(saved["extras"])
        self.scene.load_state_dict(saved["scene"])
        for name, state in saved["managers"].items():
            self.managers[name].load_state_dict(state)
        self.streams.load_state_dict(saved["streams"])
        self._term_state.restore(saved.get("attributes", {}))
        self.recorder_manager.forget()
        forget()

    def describe(self) -> str:
        """Return a table for each manager: its terms, shapes, weights."""
        shown = [m for name, m in self.managers.items() if name != "recorders" or m.active_terms]
        return "\n\n".join(map(str, shown))
