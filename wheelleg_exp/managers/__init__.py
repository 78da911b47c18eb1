"""The eight managers: when terms run, what they accumulate, what they log."""

from wheelleg_exp.managers.action_manager import ActionManager, ActionTerm
from wheelleg_exp.managers.command_manager import CommandManager, CommandTerm
from wheelleg_exp.managers.curriculum_manager import CurriculumManager
from wheelleg_exp.managers.entity import SceneEntityCfg
from wheelleg_exp.managers.event_manager import EventManager
from wheelleg_exp.managers.face import Env
from wheelleg_exp.managers.observation_manager import ObservationManager
from wheelleg_exp.managers.ranges import bounds, interval
from wheelleg_exp.managers.reward_manager import RewardManager
from wheelleg_exp.managers.scene_manager import SceneManager
from wheelleg_exp.managers.term import Term, TermBase
from wheelleg_exp.managers.termination_manager import TerminationManager

__all__ = [
    "ActionManager",
    "ActionTerm",
    "CommandManager",
    "CommandTerm",
    "CurriculumManager",
    "Env",
    "EventManager",
    "ObservationManager",
    "RewardManager",
    "SceneEntityCfg",
    "SceneManager",
    "Term",
    "TermBase",
    "TerminationManager",
    "bounds",
    "interval",
]
