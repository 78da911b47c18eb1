"""Curriculum terms: what changes while a policy learns. Each returns the state that is logged.

| module | what it changes |
|---|---|
| `weights` | weights of rewards |
| `levels` | the tiles that robots stand on, and the ranges of commands, as others do |
| `skill` | the ranges of commands, by skill above standing still |
| `distance` | the tiles that robots stand on, by the way along their commands |
| `modify`, `address` | any setting, by its address |
"""

from wheelleg_exp.mdp.curriculums.distance import terrain_levels_by_distance
from wheelleg_exp.mdp.curriculums.levels import (
    ang_vel_cmd_levels,
    command_range_levels,
    lin_vel_cmd_levels,
    terrain_levels_vel,
)
from wheelleg_exp.mdp.curriculums.modify import modify_env_param, modify_term_cfg
from wheelleg_exp.mdp.curriculums.skill import command_levels_by_skill
from wheelleg_exp.mdp.curriculums.weights import modify_reward_weight

__all__ = [
    "ang_vel_cmd_levels",
    "command_levels_by_skill",
    "command_range_levels",
    "lin_vel_cmd_levels",
    "modify_env_param",
    "modify_reward_weight",
    "modify_term_cfg",
    "terrain_levels_by_distance",
    "terrain_levels_vel",
]
