"""A robot and a config with round numbers, which the tests of the lint rules change.

The robot has 1 kg, at a gravity of 10 m/s². Two wheels of 0.1 m radius are 0.5 m apart. A mass of 0.8 kg is 0.5 m above
the axle, with an inertia of 0.4 kg·m² about the axle. So m g h = 4 N·m, and the rate of the fall is sqrt(4 / 0.4) 1/s.
"""

import copy
import math
from dataclasses import replace
from typing import Any

from env.composed import composed

from wheelleg_exp.anatomy.compiled_robot import Balance, Drive, Joint, RobotFacts
from wheelleg_exp.config.schema import Experiment
from wheelleg_exp.lint.physics_check import RULES
from wheelleg_exp.lint.rule import Case, Finding
from wheelleg_exp.terms.config_sections import read_section

LEG_DRIVE = Drive("legs", stiffness=40.0, damping=2.0, effort=8.0, velocity=10.0)
WHEEL_DRIVE = Drive("wheels", stiffness=0.0, damping=1.0, effort=0.4, velocity=20.0)
LEG = Joint(
    default=0.5, default_velocity=0.0, low=-1.0, high=1.5, armature=0.01, inertia=0.04, effective=0.1,
    hold=2.0, drive=LEG_DRIVE,
)  # fmt: skip
WHEEL = Joint(
    default=0.0, default_velocity=0.0, low=-math.inf, high=math.inf, armature=0.001, inertia=0.002, effective=0.02,
    hold=0.0, drive=WHEEL_DRIVE,
)  # fmt: skip
FACTS = RobotFacts(
    mass=1.0,
    gravity=10.0,
    joints={"hip": LEG, "left": WHEEL, "right": WHEEL},
    wheels=("left", "right"),
    wheel_radius=0.1,
    track=0.5,
    standing_height=0.4,
    clearance=0.0,
    friction=0.8,
    balance=Balance(mass=0.8, height=0.5, inertia=0.4, pole=2.0, pendulum=math.sqrt(10.0)),
)

_MDP = "wheelleg_exp.mdp."
_STOCK = composed("task=stand").config
CONFIG: dict[str, Any] = {
    **_STOCK,
    "env": {
        **_STOCK["env"],
        "num_envs": 8,
        "episode_length_s": 10.0,
        "decimation": 2,
        "sim": {**_STOCK["env"]["sim"], "dt": 0.01},
        "scene": {
            "env_spacing": 1.0,
            "terrain": {"_target_": "wheelleg_exp.sim.terrain.Plane", "static_friction": 0.6, "dynamic_friction": 0.4},
            "sensors": {},
        },
        **{section: {} for section in ("commands", "actions", "observations", "events", "rewards", "curriculum")},
        "terminations": {"time_out": {"_target_": _MDP + "terminations.time_out", "time_out": True}},
    },
    "agent": {
        **_STOCK["agent"],
        "num_steps_per_env": 10,
        "max_iterations": 20,
        "average_iterations": 0,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "algorithm": {"num_mini_batches": 4, "gamma": 0.995},
        "actor": {},
        "critic": {},
    },
}
CONFIG["env"]["robot"] |= {"friction_source": "static"}
CONFIG["env"]["robot"]["init_state"] |= {"pos": [0.0, 0.0, 0.4]}


def term(target: str, **settings: Any) -> dict[str, Any]:
    return {"_target_": _MDP + target, **settings}


def joints(*names: str) -> dict[str, Any]:
    return {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "robot", "joint_names": list(names)}


def _merged(old: Any, new: Any) -> Any:
    if not isinstance(old, dict) or not isinstance(new, dict) or "_target_" in new:
        return new
    return {**old, **{name: _merged(old.get(name), value) for name, value in new.items()}}


def case(facts: RobotFacts = FACTS, **sections: Any) -> Case:
    """Return the round case with changed sections of ``env``, or of the ``agent`` section."""
    config = copy.deepcopy(CONFIG)
    for name, value in sections.items():
        place = config["agent"] if name in config["agent"] else config["env"]
        place[name] = _merged(place.get(name), value)
    return Case(read_section(Experiment, config, ""), facts)


def with_joint(name: str, **changes: Any) -> RobotFacts:
    """Return the round robot with one changed joint; ``drive`` changes the drive of the joint."""
    joint = FACTS.joints[name]
    if "drive" in changes:
        assert joint.drive is not None
        changes["drive"] = replace(joint.drive, **changes["drive"])
    return replace(FACTS, joints={**FACTS.joints, name: replace(joint, **changes)})


def found(rule: str, looked_at: Case) -> list[Finding]:
    return RULES[rule](looked_at)
