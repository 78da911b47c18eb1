"""The nine managers: when terms run, what they accumulate, what they log.

| module | what it offers |
|---|---|
| `*_manager` | when terms run, what they accumulate, what they log |
| `manager_base`, `term` | binding, listing, printing and state of terms |
| `environment` | what terms may ask of the environment |
| `entity` | members of the scene, and named ranges, as terms take them |
| `returned`, `finite` | what terms return, told by the key of the term |
| `asking` | what a step asks of a device, which waits late or never |
| `recorded_rows` | what recorders note, cut into episodes |
| `streams` | random draws, a stream for each term |
| `buffers`, `observation_term` | history of samples, and what becomes of one |
"""

from wheelleg_exp.managers.action_manager import ActionManager, ActionTerm
from wheelleg_exp.managers.command_manager import CommandManager, CommandTerm
from wheelleg_exp.managers.curriculum_manager import CurriculumManager
from wheelleg_exp.managers.event_manager import EventManager
from wheelleg_exp.managers.manager_base import ManagerTermBase, Term, TermBase
from wheelleg_exp.managers.observation_manager import ObservationManager
from wheelleg_exp.managers.recorder_manager import RecorderManager, RecorderTerm
from wheelleg_exp.managers.reward_manager import RewardManager
from wheelleg_exp.managers.scene_manager import SceneManager
from wheelleg_exp.managers.term_interface import Env, SceneEntityCfg, bounds, member
from wheelleg_exp.managers.termination_manager import TerminationManager

__all__ = [
    "ActionManager",
    "ActionTerm",
    "CommandManager",
    "CommandTerm",
    "CurriculumManager",
    "Env",
    "EventManager",
    "ManagerTermBase",
    "ObservationManager",
    "RecorderManager",
    "RecorderTerm",
    "RewardManager",
    "SceneEntityCfg",
    "SceneManager",
    "Term",
    "TermBase",
    "TerminationManager",
    "bounds",
    "member",
]
