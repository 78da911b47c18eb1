"""The base class of class terms."""

from wheelleg_exp.managers import ManagerTermBase

__all__ = ["ManagerTermBase"]
