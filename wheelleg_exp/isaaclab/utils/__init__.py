"""The part of ``isaaclab.utils`` that terms import: ``configclass``, mathematics, and the matching of names."""

from wheelleg_exp.isaaclab.utils.configclass import configclass
