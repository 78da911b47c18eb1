"""What terms import of ``isaaclab.managers``: entities, the base classes of terms, and names for annotations."""

from wheelleg_exp.isaaclab.managers.action_manager import ActionTerm
from wheelleg_exp.isaaclab.managers.command_manager import CommandTerm
from wheelleg_exp.isaaclab.managers.manager_term_cfg import (
    ActionTermCfg,
    CommandTermCfg,
    CurriculumTermCfg,
    EventTermCfg,
    ManagerTermBaseCfg,
    ObservationTermCfg,
    RewardTermCfg,
    TerminationTermCfg,
)
from wheelleg_exp.managers import (
    ActionManager,
    CommandManager,
    CurriculumManager,
    EventManager,
    ManagerTermBase,
    ObservationManager,
    RewardManager,
    SceneEntityCfg,
    TerminationManager,
)

__all__ = [
    "ActionManager",
    "ActionTerm",
    "ActionTermCfg",
    "CommandManager",
    "CommandTerm",
    "CommandTermCfg",
    "CurriculumManager",
    "CurriculumTermCfg",
    "EventManager",
    "EventTermCfg",
    "ManagerTermBase",
    "ManagerTermBaseCfg",
    "ObservationManager",
    "ObservationTermCfg",
    "RewardManager",
    "RewardTermCfg",
    "SceneEntityCfg",
    "TerminationManager",
    "TerminationTermCfg",
]
