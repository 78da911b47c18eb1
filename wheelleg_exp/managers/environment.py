"""What managers and terms may ask of the environment."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

import torch

from wheelleg_exp.managers.streams import Streams
from wheelleg_exp.sim.scene import Scene

if TYPE_CHECKING:
    from wheelleg_exp.managers.action_manager import ActionManager
    from wheelleg_exp.managers.command_manager import CommandManager
    from wheelleg_exp.managers.curriculum_manager import CurriculumManager
    from wheelleg_exp.managers.event_manager import EventManager
    from wheelleg_exp.managers.observation_manager import ObservationManager
    from wheelleg_exp.managers.recorder_manager import RecorderManager
    from wheelleg_exp.managers.reward_manager import RewardManager
    from wheelleg_exp.managers.termination_manager import TerminationManager


class Env(Protocol):
    """The environment as terms see it; names and meanings are Isaac Lab's.

    Attributes:
        cfg: the composed ``env`` section, by attribute or key.
        num_envs: number of environments, N.
        device: where all tensors are.
        physics_dt: physics step, s.
        step_dt: control step, s.
        max_episode_length_s: longest episode, s.
        max_episode_length: longest episode, control steps.
        episode_length_buf: control steps of each present episode, (N,) long.
        common_step_counter: control steps since construction.
        scene: ground, robot and sensors.
        streams: the named random streams.
        observers: called in every step after the rewards and before the resets.
    """

    cfg: Any
    num_envs: int
    device: torch.device
    physics_dt: float
    step_dt: float
    max_episode_length_s: float
    max_episode_length: int
    episode_length_buf: torch.Tensor
    common_step_counter: int
    scene: Scene
    streams: Streams
    observers: list[Callable[[], None]]
    command_manager: CommandManager
    action_manager: ActionManager
    observation_manager: ObservationManager
    event_manager: EventManager
    reward_manager: RewardManager
    termination_manager: TerminationManager
    curriculum_manager: CurriculumManager
    recorder_manager: RecorderManager
