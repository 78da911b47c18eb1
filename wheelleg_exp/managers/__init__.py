"""The nine managers: when terms run, what they accumulate, and what they log.

| module | content |
|---|---|
| `*_manager` | when the terms of one section run, what they accumulate, what they log |
| `manager_base` | bound terms, and the base class of the managers |
| `term_interface` | the environment as terms see it, members of the scene, named ranges |
| `return_checks`, `non_finite` | errors that name the term: wrong return values, NaN and inf |
| `async_queries` | masks and finite checks that do not wait for a GPU |
| `streams` | random draws, one stream for each term |
| `observation_term`, `sample_history` | an observation from function to sample, and histories of samples |
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
