"""A tape of operations stands in for a CUDA graph, so that a recorded step is tried without a GPU."""

from __future__ import annotations

import torch
from sim.small_envs import ASSETS
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from env.composed import composed
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.captured import Captured
from wheelleg_exp.env.captured_step import CapturedReset, CapturedStep, captured_commands, captured_look

# What a graph cannot hold: the host waits for a number, or brings one.
WAITS = ("_local_scalar_dense", "nonzero", "lift_fresh")


class Tape(TorchDispatchMode):
    """Notes torch's operations with their memory, and does them again on the same memory."""

    def __init__(self, streams=()) -> None:
        super().__init__()
        self.notes: list = []
        self.is_new = True

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        if operation.__name__.split(".")[0] in WAITS:
            raise RuntimeError("operation not permitted when stream is capturing")
        result = operation(*args, **(kwargs or {}))
        self.notes.append((operation, args, kwargs or {}, result))
        return result

    def record(self, work):
        with self:
            work()

    def replay(self):
        if self.is_new:  # a graph's recording does nothing, the tape's has done it
            self.is_new = False
            return
        for operation, args, kwargs, result in self.notes:
            again = operation(*args, **kwargs)
            for old, new in zip(tree_flatten(result)[0], tree_flatten(again)[0], strict=True):
                if isinstance(old, torch.Tensor) and old.numel() and old.data_ptr() != new.data_ptr():
                    old.copy_(new)


def stand(task: str = "stand", *more: str) -> ManagerBasedRLEnv:
    words = [f"task={task}", "env.num_envs=16", "env.sim.nthread=1", "env.episode_length_s=0.5", *more]
    env = ManagerBasedRLEnv(composed(*words).config["env"], ASSETS / "legged.xml", 0)
    env.reset(seed=0)
    return env


def parts(env: ManagerBasedRLEnv) -> list[Captured]:
    step = env._captured
    return [step.act, step.act_again, step.judge, step.reward, env._captured_look, env._captured_commands]


def recorded(env: ManagerBasedRLEnv) -> ManagerBasedRLEnv:
    """Let an environment's step be taped as a GPU's would be captured."""
    env._captured = CapturedStep(env)
    env._captured_look = captured_look(env)
    env._captured_reset = CapturedReset(env)
    env._captured_commands = captured_commands(env)
    return env
