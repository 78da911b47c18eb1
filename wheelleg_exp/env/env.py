"""The environment: the order of one step and of one reset."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import torch

from wheelleg_exp import managers
from wheelleg_exp.env.graph_capture import GraphCapture, captured_part
from wheelleg_exp.env.isaaclab_attributes import Cfg, IsaacLabAttributes
from wheelleg_exp.env.realism import with_realism, without_errors
from wheelleg_exp.machine import require_memory
from wheelleg_exp.managers.async_queries import AsyncMaskQuery
from wheelleg_exp.managers.non_finite import failures, note_observations, require_finite_observations
from wheelleg_exp.managers.observation_term import Group
from wheelleg_exp.managers.streams import Streams
from wheelleg_exp.sim.ids import ids_where
from wheelleg_exp.sim.options import EnvOptions, read_env
from wheelleg_exp.sim.scene import RobotState
from wheelleg_exp.sim.timers import forget
from wheelleg_exp.sim.warp_runtime import require_device
from wheelleg_exp.state import Settings, cloned, register_undeclared, tree
from wheelleg_exp.state.values import PLAIN
from wheelleg_exp.terms.config_sections import plain_section

# One environment needs at least 10,000 bytes of memory for its physics and observations.
_BYTES_PER_ENV = 10_000
_MANAGERS = ("event", "command", "recorder", "action", "observation", "termination", "reward", "curriculum")
# The environment or its caller sets these attributes. A curriculum or a user-defined term can set all others.
_OWN = ("seed", "common_step_counter", "extras", "keep_final_obs", "autoreset", "observers")

Observations = dict[str, Group]
AutoresetMode = Literal["same_step", "next_step", "disabled"]
StepResult = tuple[Observations, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]


class ManagerBasedRLEnv(IsaacLabAttributes):
    """N parallel environments with nine managers, in the style of Isaac Lab's ``ManagerBasedRLEnv``.

    ``cfg`` is the config section ``env``, as options or as a mapping, ``mjcf`` is the robot's MJCF file, and ``seed``
    seeds all random streams. The decorator ``captured_part`` has an effect only on a GPU with ``env.sim.graph_step``;
    see ``graph_capture``.

    Attributes:
        device: device of all tensors.
        autoreset: when an environment whose episode ended is reset: within the same step; in the next step, which then
            does nothing else; or only by the caller.
        keep_final_obs: whether ``extras["final_obs"]`` holds the last observations of episodes that end.
        observers: functions that each control step calls after computing rewards and before resetting environments.
        reset_order: the managers in the order in which a reset of environments resets the managers.
    """

    def __init__(self, cfg: EnvOptions | Mapping[str, object], mjcf: Path, seed: int) -> None:
        self.options = options = with_realism(read_env(cfg))
        self.cfg = Cfg(plain_section(options))
        self.seed = seed
        self.num_envs = options.num_envs
        self.exact_envs, self.prompt_envs = without_errors(options)
        require_memory(_BYTES_PER_ENV * self.num_envs, "env.num_envs", f"{self.num_envs:,} environments")
        self.decimation = options.decimation
        self.device = torch.device(options.sim.device)
        require_device(self.device)
        self.physics_dt = float(options.sim.dt)
        self.step_dt = self.physics_dt * self.decimation
        self.max_episode_length_s = self.number("max_episode_length_s", float(options.episode_length_s), saved=False)
        # Round before ``ceil``, because an episode of 5 s with control steps of 2/120 s must have 300 steps, not 301.
        steps = math.ceil(round(self.max_episode_length_s / self.step_dt, 9))
        self.max_episode_length = self.number("max_episode_length", steps, saved=False)
        self.common_step_counter = 0
        lengths = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
        self.episode_length_buf = self.buffer("episode_length_buf", lengths)
        self.streams = Streams(seed, self.device)
        self.extras: dict[str, Any] = {}
        self.keep_final_obs = False
        self.autoreset: AutoresetMode = "same_step"
        self.observers: list[Callable[[], None]] = []

        self.scene_manager = managers.SceneManager(options, mjcf, self.num_envs, self.streams.get)
        self.scene = self.scene_manager.scene
        self.event_manager = managers.EventManager(options.events, self)
        self.event_manager.apply("prestartup")
        self.scene.play()
        self.event_manager.play()
        self.command_manager = managers.CommandManager(options.commands, self)
        recorders = managers.RecorderManager(options.recorders, options.dataset, self)
        self.recorder_manager: managers.RecorderManager = recorders
        self.action_manager = managers.ActionManager(options.actions, self)
        self.observation_manager = managers.ObservationManager(options.observations, self)
        self.termination_manager = managers.TerminationManager(options.terminations, self)
        self.reward_manager = managers.RewardManager(options.rewards, self)
        curriculum = managers.CurriculumManager(options.curriculum, self)
        self.curriculum_manager: managers.CurriculumManager = curriculum
        self.event_manager.apply(
            "startup", with_errors=torch.arange(self.exact_envs, self.num_envs, device=self.device)
        )
        self.reward_buf = self.buffer("reward_buf", torch.zeros(self.num_envs, device=self.device))
        self.reset_order: list[Any] = [
            *(self.observation_manager, self.action_manager, self.reward_manager, self.curriculum_manager),
            *(self.command_manager, self.event_manager, self.termination_manager, self.recorder_manager),
        ]
        self._ended = AsyncMaskQuery(self.num_envs, self.device)
        self._sensors_refresh = any(sensor.measures_at_reset for sensor in self.scene.sensors.values())
        # With recorder terms, capture no CUDA graph, because recorder terms wait for the GPU in every step.
        captures = self.scene.sim.is_captured and not self.recorder_manager.active_terms
        self.graph_capture = GraphCapture(self) if captures else None
        for name in ("scene", *(f"{kind}_manager" for kind in _MANAGERS)):
            self.child(name, getattr(self, name), saved=False)
        owned = frozenset([id(self.streams), *(id(part) for _, part in tree(self))])
        for _, part in list(tree(self)):
            register_undeclared(part, owned)
        self.scene.require_compiled_model()
        # Keep this line last: checkpoints store every attribute that the environment gets after this line.
        own = [*_OWN, "_attributes", *(name for name, value in vars(self).items() if type(value) not in PLAIN)]
        self._attributes = Settings({"attributes": vars(self)}, "env", skip=own)

    @property
    def managers(self) -> dict[str, Any]:
        """The environment's nine managers, by the names of their config sections."""
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
        """Advance every environment by one control step with raw actions (N, A), with Isaac Lab's order of operations.

        Terminations and rewards are computed from the state after the physics steps. Environments whose episode ended
        are reset after the rewards have been computed. The observation returned for a reset environment is the first
        one of the new episode. New commands and interval events follow the resets, so the returned observation shows
        the effect of a push.

        ``step`` returns observations by group, reward (N,), terminated (N,), truncated (N,), and extras. If an
        environment's physics or reward is NaN or inf, its episode terminates with reward 0. The entry
        ``extras["non_finite"]`` names the reward terms or the physics that produced NaN or inf. Raise SimulationFailure
        if an observation or a number that an event wrote is NaN or inf.
        """
        self.settings_may_have_changed()
        # ``skipped`` is the mask (N,) of environments that this step only resets.
        ends, is_late = self.termination_manager, self.autoreset == "next_step"
        skipped = ends.dones & (self.episode_length_buf > 0) if is_late else None
        self._act(action)
        for substep in range(self.decimation):
            if substep:
                self._update_and_act()
            self.scene.sim.step()
            self.recorder_manager.record_post_physics_decimation_step()
        self.common_step_counter += 1
        done, unstable = self._update_and_terminate(skipped)
        self._ended.start(done, unstable)  # This starts a copy of the masks to the host.
        self.reward_manager.start_step()
        reward_failed = self._compute_reward(skipped)
        ended = self._end_episodes(reward_failed)
        for observe in self.observers:
            observe()
            self.settings_may_have_changed()
        self.recorder_manager.record_post_step()

        if self.autoreset != "same_step":
            ended = ids_where(torch.zeros_like(done) if skipped is None else skipped)
        self._reset_ended(ended)
        if self.command_manager.may_draw(self.step_dt):
            self._advance_commands(draws=True)
            self.settings_may_have_changed()
        else:
            self._advance_without_draws()
        if self.event_manager.apply_due(self.step_dt) or self._sensors_refresh:
            self.settings_may_have_changed()
        self.scene.show_written()
        observations = self._observe()
        if self.graph_capture is not None:
            observations = cloned(observations)  # The next replay overwrites the memory of the CUDA graph.
        if self.autoreset == "same_step":
            # If ``autoreset`` is ``next_step`` or ``disabled``, observations of failed environments can be NaN.
            require_finite_observations(self, is_noted=True)
        return observations, self.reward_buf.clone(), ends.terminated.clone(), ends.time_outs.clone(), self.extras

    def settings_may_have_changed(self) -> None:
        """Compare all settings before the next replay of a CUDA graph, because user-defined code has run."""
        if self.graph_capture is not None:
            self.graph_capture.is_checked = False

    def reset(
        self, seed: int | None = None, env_ids: torch.Tensor | None = None
    ) -> tuple[Observations, dict[str, object]]:
        """Reset the environments ``env_ids`` (by default all), and return the observations of all environments.

        The observations of environments that are not reset do not change. A ``seed`` restarts all random streams.
        Commands are drawn but not post-processed here, as in Isaac Lab: the first observation shows the drawn command
        even of an environment that is commanded to stand still.
        """
        return self._restart(seed, env_ids, None, False)

    def reset_to(
        self,
        state: RobotState,
        env_ids: torch.Tensor | None = None,
        seed: int | None = None,
        is_relative: bool = False,
    ) -> tuple[Observations, dict[str, object]]:
        """Reset environments like ``reset``, but start the robots in a given state, as in Isaac Lab.

        ``state`` has the layout of ``scene.get_state``; row i belongs to the environment ``env_ids[i]``.
        """
        return self._restart(seed, env_ids, state, is_relative)

    def _restart(
        self, seed: int | None, env_ids: torch.Tensor | None, state: RobotState | None, is_relative: bool
    ) -> tuple[Observations, dict[str, object]]:
        self.settings_may_have_changed()
        ids = torch.arange(self.num_envs, device=self.device) if env_ids is None else torch.unique(env_ids)
        self.recorder_manager.record_pre_reset(ids)
        if seed is not None:
            self.seed = seed
            self.streams.reseed(seed)
        if len(ids):
            self._reset_idx(ids)
        if state is not None:
            self.scene.reset_to(state, env_ids, is_relative)
        self.scene.refresh()
        self.recorder_manager.record_post_reset(ids)
        only = None
        if env_ids is not None:
            only = torch.zeros_like(self.termination_manager.dones).index_fill_(0, ids, True)
        observations = self.observation_manager.compute(only)
        require_finite_observations(self, only)
        return observations, self.extras

    @captured_part
    def _act(self, action: torch.Tensor) -> None:
        """Process the action, and write the controls for the control step's first physics step."""
        self.action_manager.process_action(action)
        self.recorder_manager.record_pre_step()
        self.scene.robot.begin_control_step()
        self.action_manager.apply_action()
        self.scene.write_data_to_sim()

    @captured_part
    def _update_and_act(self) -> None:
        """Read the result of a physics step, and apply the control step's action for the next physics step."""
        self.scene.update()
        self.observation_manager.sample_between()
        self.action_manager.apply_action()
        self.scene.write_data_to_sim()

    @captured_part
    def _update_and_terminate(self, skipped: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor]:
        """Read the last physics step's result; return masks (N,) of the ended episodes and the failed simulations."""
        self.scene.update()
        self.episode_length_buf += 1
        done, unstable = self.termination_manager.compute(skipped), self.scene.unstable()
        if skipped is not None:
            unstable = unstable & ~skipped
        return done | unstable, unstable

    @captured_part
    def _compute_reward(self, skipped: torch.Tensor | None) -> torch.Tensor:
        """Compute ``reward_buf``; return a mask (N,) of the environments whose reward is NaN or inf."""
        self.reward_buf = self.reward_manager.compute(self.step_dt, skipped)
        failed = self.reward_manager.failed
        return failed if skipped is None else failed & ~skipped

    def _end_episodes(self, reward_failed: torch.Tensor) -> torch.Tensor:
        """End the episodes of failed environments; return the ids (n,) of all environments whose episode ended."""
        needs_all = bool(self.observers or self.recorder_manager.active_terms or self.keep_final_obs)
        ended, failed = self._ended.ids(reward_failed, at_once=needs_all or self.autoreset != "same_step")
        self.extras.pop("non_finite", None)
        self._end_failed(failed)
        return ended

    def _end_failed(self, env_ids: torch.Tensor) -> None:
        """End the episodes of environments whose physics or reward is NaN or inf; name failed terms in ``extras``."""
        if len(env_ids):
            self.reward_manager.exclude(env_ids[self.reward_manager.failed[env_ids]])
            found = failures(self, env_ids)
            self.extras.setdefault("non_finite", found)["keys"].update(found["keys"])
            self.termination_manager.force(env_ids)

    def _reset_ended(self, ended: torch.Tensor) -> None:
        """Reset the environments ``ended`` (n,), and those whose NaN reward ``_end_episodes`` did not know yet."""
        self.extras["log_is_fresh"] = False
        self.extras.pop("final_obs", None)
        if len(ended):
            if self.keep_final_obs:
                self.extras["final_obs"] = self.observation_manager.peek()
            self.recorder_manager.record_pre_reset(ended)
            self._reset_idx(ended)
            self.recorder_manager.record_post_reset(ended)
        # ``_end_episodes`` did not wait until the GPU had computed the rewards, so some NaN rewards are found only now.
        failed, not_reset = self._ended.late()
        self._end_failed(failed)
        if len(not_reset):
            log = self.extras.get("log") if self.extras["log_is_fresh"] else None
            self._reset_idx(not_reset)
            # If this step has already reset other environments, keep the log of their episodes.
            self.extras["log"] = log or self.extras["log"]

    def _reset_idx(self, env_ids: torch.Tensor) -> None:
        # Run the curriculum first, because the curriculum needs the terminal state, which reset events overwrite.
        self.curriculum_manager.compute(env_ids)
        if self.curriculum_manager.active_terms:
            self.settings_may_have_changed()
        self.command_manager.read_settings()
        # Select the robots with errors outside of the CUDA graph, because their number varies.
        self.extras["log"] = self._reset_rows(env_ids, env_ids[env_ids >= self.exact_envs] if self.exact_envs else None)
        self.extras["log_is_fresh"] = True

    @captured_part
    def _reset_rows(self, env_ids: torch.Tensor, with_errors: torch.Tensor | None) -> dict[str, object]:
        """Reset the simulations and the managers of ``env_ids``; return the log of the episodes that ended.

        If some robots are exact, ``with_errors`` are those of ``env_ids`` that have the errors of ``env.realism``.
        """
        log: dict[str, object] = {**self.scene.diagnostics(env_ids)}
        self.scene.reset(env_ids)
        self.event_manager.apply("reset", env_ids, self.common_step_counter, with_errors)
        for manager in self.reset_order:
            log.update(manager.reset(env_ids))
        self.episode_length_buf.index_fill_(0, env_ids, 0)
        return log

    @captured_part
    def _advance_without_draws(self) -> None:
        self._advance_commands(draws=False)

    def _advance_commands(self, draws: bool) -> None:
        """Advance the commands and the timers of interval events; draw new commands where their timer expired."""
        self.command_manager.compute(self.step_dt, draws)
        self.event_manager.advance_timers(self.step_dt)

    @captured_part
    def _observe(self) -> Observations:
        observations: Observations = self.observation_manager.compute()
        if self.autoreset == "same_step":
            note_observations(self)
        return observations

    def apply_event(self, mode: str, env_ids: torch.Tensor | None = None) -> None:
        """Run the events of a user-defined mode, and update all quantities that are derived from the robot's state."""
        self.event_manager.apply(mode, env_ids, self.common_step_counter)
        self.scene.refresh()

    def state_dict(self) -> dict[str, object]:
        """Return the environment's complete state; raise ConfigError if a term holds state that cannot be saved."""
        self.scene.require_compiled_model()
        attributes = self._attributes.state_dict()
        managers = {name: manager.state_dict() for name, manager in self.managers.items() if name != "scene"}
        return {
            "seed": self.seed,
            "common_step_counter": self.common_step_counter,
            "episode_length_buf": self.episode_length_buf.clone(),
            "reward_buf": self.reward_buf.clone(),
            "extras": cloned(self.extras),
            "streams": self.streams.state_dict(),
            "scene": self.scene.state_dict(),
            "managers": {name: state for name, state in managers.items() if state},
            **({"attributes": attributes} if attributes else {}),
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore a state that ``state_dict`` returned, in an environment that was built from the same config."""
        self.settings_may_have_changed()
        saved = {name: part if name == "streams" else cloned(part, self.device) for name, part in saved.items()}
        self.seed = saved["seed"]
        self.common_step_counter = saved["common_step_counter"]
        self.episode_length_buf.copy_(saved["episode_length_buf"])
        self.reward_buf = saved["reward_buf"].clone()
        self.extras = cloned(saved["extras"])
        self.scene.load_state_dict(saved["scene"])
        for name, state in saved["managers"].items():
            self.managers[name].load_state_dict(state)
        self.streams.load_state_dict(saved["streams"])
        self._attributes.load_state_dict(saved.get("attributes", {}))
        self.recorder_manager.forget()
        forget()

    def describe(self) -> str:
        """Return a table for each manager: its terms, shapes, and weights."""
        shown = [m for name, m in self.managers.items() if name != "recorders" or m.active_terms]
        return "\n\n".join(map(str, shown))
