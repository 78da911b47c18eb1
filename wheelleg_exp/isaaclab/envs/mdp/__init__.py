"""The stock terms under one name, as ``isaaclab.envs.mdp`` has them; ``docs/terms.md`` lists them with parameters."""

from wheelleg_exp.isaaclab.envs.mdp.actions import *  # noqa: F403
from wheelleg_exp.isaaclab.envs.mdp.commands import *  # noqa: F403
from wheelleg_exp.isaaclab.envs.mdp.curriculums import *  # noqa: F403
from wheelleg_exp.isaaclab.envs.mdp.events import *  # noqa: F403
from wheelleg_exp.isaaclab.envs.mdp.observations import *  # noqa: F403
from wheelleg_exp.isaaclab.envs.mdp.rewards import *  # noqa: F403
from wheelleg_exp.isaaclab.envs.mdp.terminations import *  # noqa: F403
