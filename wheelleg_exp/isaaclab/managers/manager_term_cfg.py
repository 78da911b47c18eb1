"""The configs of terms: what class terms get as ``cfg``, and the base classes of configs of actions and commands."""

from __future__ import annotations

from typing import Any

from wheelleg_exp.isaaclab.utils.configclass import configclass
from wheelleg_exp.managers import Term

ManagerTermBaseCfg = Term
RewardTermCfg = ObservationTermCfg = TerminationTermCfg = EventTermCfg = CurriculumTermCfg = Term


@configclass
class ActionTermCfg:
    """The config of an action: the YAML node's parameters by attribute.

    Attributes:
        class_type: unused: the node's ``_target_`` is the class.
        asset_name: the robot's name in the scene.
        debug_vis: unused: nothing is drawn while it runs.
        clip: bounds by joint expression, for the term to apply.
    """

    class_type: Any = None
    asset_name: str = "robot"
    debug_vis: bool = False
    clip: dict[str, tuple[float, float]] | None = None


@configclass
class CommandTermCfg:
    """The config of a command: the YAML node's parameters by attribute.

    Attributes:
        class_type: unused: the node's ``_target_`` is the class.
        resampling_time_range: shortest and longest time between two draws, s.
        debug_vis: unused: nothing is drawn while it runs.
    """

    class_type: Any = None
    resampling_time_range: tuple[float, float] = (10.0, 10.0)
    debug_vis: bool = False
