"""What terms import of ``isaaclab.utils``: ``configclass``, mathematics and the matching of names."""

from wheelleg_exp.isaaclab.utils.configclass import configclass

__all__ = ["configclass"]
