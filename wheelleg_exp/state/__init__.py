"""What objects keep between steps: found, saved, restored, or refused by name.

| name | what it is for |
|---|---|
| `Stateful` | a base class whose attributes are its state |
| `made`, `save`, `restore`, `stateful` | the same for objects of any class |
| `Settings` | the settings of a term, which are state once something has changed them |
| `Kept`, `NamedStream` | what somebody else saves, so that a reference to it is no state |
| `Outside` | what a term changes although it is not its own: noticed and named |
| `merged` | the states of some environments put together with those of the others |
| `Memory` | tensors of one object that lie in the memory of another: refused |
"""

from wheelleg_exp.state.saved_values import Kept, NamedStream, cloned, on_device, same
from wheelleg_exp.state.stateful import Settings, Stateful, adopt, made, restore, save, stateful
from wheelleg_exp.state.tensor_trees import merged
from wheelleg_exp.state.unsaved_state import Memory, Outside

__all__ = [
    "Kept",
    "Memory",
    "NamedStream",
    "Outside",
    "Settings",
    "Stateful",
    "adopt",
    "cloned",
    "made",
    "merged",
    "on_device",
    "restore",
    "same",
    "save",
    "stateful",
]
