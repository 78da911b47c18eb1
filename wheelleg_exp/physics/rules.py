"""All rules of ``wheelleg check --physics``, by name; importing this module registers them."""

from __future__ import annotations

from wheelleg_exp.config.schema import PHYSICS_RULES
from wheelleg_exp.physics import (
    rules_actions,
    rules_disturbances,
    rules_drives,
    rules_learning,
    rules_observations,
    rules_randomisation,
    rules_rewards,
    rules_start,
)
from wheelleg_exp.physics.findings import RULES as _RULES
from wheelleg_exp.physics.findings import Rule

_MODULES = (
    rules_randomisation,
    rules_observations,
    rules_rewards,
    rules_drives,
    rules_actions,
    rules_start,
    rules_disturbances,
    rules_learning,
)

# In the order of their names, as the schema lists them.
RULES: dict[str, Rule] = {name: _RULES[name] for name in PHYSICS_RULES}
