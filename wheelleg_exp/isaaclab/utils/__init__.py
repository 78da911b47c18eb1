"""Provide the parts of ``isaaclab.utils`` that terms import, such as ``configclass`` and mathematical functions."""

from wheelleg_exp.isaaclab.utils.configclass import configclass
