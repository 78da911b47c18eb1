"""The part of ``isaaclab.utils`` that terms import: ``configclass``, mathematics, and functions that match names."""

from wheelleg_exp.isaaclab.utils.configclass import configclass
