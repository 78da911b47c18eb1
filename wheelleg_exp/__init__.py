"""Config-first, reproducible reinforcement-learning experiments for wheel-legged robots on MuJoCo.

Importing the package registers its Gymnasium environments.
"""

from wheelleg_exp.gym import register_with_gymnasium

__version__ = "0.1.0"

register_with_gymnasium()
