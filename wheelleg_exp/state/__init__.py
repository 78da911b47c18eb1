"""Declared state: what outlives a control step, saved in checkpoints, restored, reset, and captured by declaration.

| module | purpose |
|---|---|
| `stateful` | the base class `Stateful`, which declares state, and `Settings`, the parameters of terms |
| `values` | copies, comparisons, and conversions of tensors and plain values |
| `old_layout` | converts the environment's state in checkpoints of format version 2 |
"""

from wheelleg_exp.state.stateful import Settings, Stateful, adopt, register_undeclared, tree
from wheelleg_exp.state.values import NamedStream, cloned, host_copy, same

__all__ = ["NamedStream", "Settings", "Stateful", "adopt", "cloned", "host_copy", "register_undeclared", "same", "tree"]
