"""Config-first, reproducible reinforcement-learning experiments for wheel-legged robots on MuJoCo.

An import of ``wheelleg_exp`` registers the package's Gymnasium environments.
"""

from wheelleg_exp.gym import register_with_gymnasium

__version__ = "1.0.0"

register_with_gymnasium()
