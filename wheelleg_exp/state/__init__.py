"""State of objects between steps: find, save, and restore it, or reject it by name.

| name | purpose |
|---|---|
| `Stateful` | base class whose attributes are its state |
| `made`, `save`, `restore`, `stateful` | the same for objects of any class |
| `Settings` | settings of a term, which are state once they have changed |
| `Kept`, `NamedStream` | objects that another part saves, so that a reference to them is not state |
| `Outside` | changes that a term makes outside its own attributes: rejected by name |
| `Memory` | tensors of two objects that share memory: rejected by name |
| `merged` | a state dict with some environments from one state and the remaining ones from another |
| module `object_graph` | the walk over objects, which graph capture uses as well |
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
