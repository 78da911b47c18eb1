"""Check whether mujoco-warp repeats a simulation bit for bit, for each of its modes and numbers of worlds.

    python benchmarks/gpu_repeat.py [--device cuda:0] [--num-envs 1 64 4096] [--modes none atomics all]
        [-- overrides ...]

Each mode of ``opt.deterministic`` makes three runs of 100 physics steps from a state in which robots stand, fall and
lie. The modes ``sorted`` and ``exact`` add the sorts of ``gpu_sorted.py``, without and with exact sums, and launch each
kernel separately. The script prints after 1, 2, 10 and 100 steps in how many worlds two runs differ, and by how much.
"""

from __future__ import annotations

import argparse
import time

from wheelleg_exp.machine import prepare_threads

prepare_threads()

import torch  # noqa: E402  (thread variables come first)
from gpu_sorted import fill_the_sorts  # noqa: E402

from wheelleg_exp.build import build_env  # noqa: E402
from wheelleg_exp.config.composing.compose import compose  # noqa: E402
from wheelleg_exp.sim.warp_engine import WarpEngine  # noqa: E402

LOOKS = (1, 2, 10, 100)
RUNS = 3
MODES = ("none", "atomics", "all", "sorted", "exact")  # The order matters: added sorts stay active.


def runs(num_envs: int, device: str, mode: str, overrides: list[str]) -> tuple[list[list[torch.Tensor]], float]:
    """Return the states of each run after each number of steps in ``LOOKS``, and the time of a step, ms."""
    words = [*overrides, "env.sim.engine=warp", f"env.sim.device={device}", f"env.num_envs={num_envs}"]
    if mode in ("sorted", "exact"):
        words.append("env.sim.graph=false")
    composed = compose(words)
    env = build_env(composed.config, asset_roots=composed.asset_roots)
    env.reset()
    engine = env.scene.sim
    assert isinstance(engine, WarpEngine)
    kinds = engine._mjw.DeterminismType
    sorts = kinds.CONTACTS | kinds.CONSTRAINT
    if mode in ("sorted", "exact"):
        fill_the_sorts(engine._wp)
    engine._m.opt.deterministic = {
        "none": 0,
        "atomics": int(kinds.ATOMICS),
        "all": int(kinds.ATOMICS | sorts),
        "sorted": int(sorts),
        "exact": int(kinds.ATOMICS | sorts),
    }[mode]
    generator = torch.Generator().manual_seed(0)
    for _ in range(60):
        action = 0.3 * torch.randn(num_envs, env.action_manager.total_action_dim, generator=generator)
        env.step(action.to(env.device))
    first, found, spent = engine.state_dict(), [], 0.0
    for _ in range(RUNS):
        engine.load_state_dict(first)
        states = []
        start = time.perf_counter()
        for index in range(1, max(LOOKS) + 1):
            engine.step()
            if index in LOOKS:
                states.append(engine.state)
        if env.device.type == "cuda":
            torch.cuda.synchronize(env.device)
        spent = time.perf_counter() - start
        found.append(states)
    return found, 1e3 * spent / max(LOOKS)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--num-envs", type=int, nargs="+", default=[1, 64, 4096])
    parser.add_argument("--modes", nargs="+", default=["none", "atomics", "all"], choices=MODES)
    parser.add_argument("overrides", nargs="*", default=["task=stand"])
    args = parser.parse_args()
    for mode in args.modes:
        for num_envs in args.num_envs:
            found, ms = runs(num_envs, args.device, mode, args.overrides)
            print(f"deterministic={mode}, {num_envs} worlds, {ms:.3f} ms a step")
            for other in found[1:]:
                for look, ours, theirs in zip(LOOKS, found[0], other, strict=True):
                    apart = int((ours != theirs).any(dim=1).sum())
                    largest = float((ours - theirs).abs().max())
                    print(f"  after {look:3d} steps: {apart} worlds differ, by at most {largest:.3g}", flush=True)


if __name__ == "__main__":
    main()
