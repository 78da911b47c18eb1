"""Compare the speed of a full ``env.step`` with the speed of MuJoCo alone, in one process.

    python benchmarks/env_throughput.py [--num-envs 512] [--steps 300] [--json] [--beside] [overrides ...]

Blocks of environment steps alternate with bare ``Batch.step`` calls of the same model and decimation, from the same
states and with the same controls, so that contacts and other load on the computer affect both measurements equally. A
second pass measures the time of each part of an environment step. ``--beside`` also measures environments with ray
sensors and terrain.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

from wheelleg_exp.machine import prepare_threads
from wheelleg_exp.sim.batch_engine import BatchEngine

prepare_threads()

import torch  # noqa: E402  (thread variables come first)
from mujoco.batch import Batch  # noqa: E402
from step_parts import time_parts  # noqa: E402

from wheelleg_exp.build import build_env  # noqa: E402
from wheelleg_exp.config.composing.compose import compose  # noqa: E402
from wheelleg_exp.env import ManagerBasedRLEnv  # noqa: E402

BLOCK = 10  # The number of steps in a block; single alternating steps would run with cold caches.


def actions(env: ManagerBasedRLEnv, steps: int) -> list[torch.Tensor]:
    """Return small random actions, equal in every call, so that episodes end at many different times."""
    generator = torch.Generator().manual_seed(0)
    width = env.action_manager.total_action_dim
    return [0.3 * torch.randn(env.num_envs, width, generator=generator) for _ in range(steps)]


def paired(env: ManagerBasedRLEnv, steps: int) -> tuple[float, float]:
    """Return the seconds spent in ``env.step`` and in bare ``Batch.step``; blocks of both alternate."""
    engine = env.scene.sim
    assert isinstance(engine, BatchEngine)
    batch = engine.batch
    bare = Batch(env.scene.model, env.num_envs, nthread=batch.nthread)
    controls = bare.bind("ctrl")
    full_time = bare_time = 0.0
    todo = actions(env, steps)
    for block in (todo[start : start + BLOCK] for start in range(0, steps, BLOCK)):
        met = []
        with torch.inference_mode():
            for action in block:
                before = batch.state.copy()
                start = time.perf_counter()
                env.step(action)
                full_time += time.perf_counter() - start
                met.append((before, batch.bind("ctrl").copy()))
        for state, control in met:
            bare.state[...] = state
            controls[...] = control
            start = time.perf_counter()
            bare.step(nstep=env.decimation)
            bare_time += time.perf_counter() - start
    return full_time, bare_time


def breakdown(env: ManagerBasedRLEnv, steps: int) -> dict[str, float]:
    """Return the time of each part of an environment step, ms."""
    spent = time_parts(env, time.perf_counter)
    start = time.perf_counter()
    with torch.inference_mode():
        for action in actions(env, steps):
            env.step(action)
    spent["other"] = time.perf_counter() - start - sum(spent.values())
    return {label: 1e3 * value / steps for label, value in spent.items()}


_SCAN = ["+sensor@env.scene.sensors=height_scanner", "+observation@env.observations.scan.terms=[sensors/height_scan]"]
_DEPTH = ["+sensor@env.scene.sensors=depth_camera", "+observation@env.observations.depth.terms=[sensors/depth_image]"]
VARIANTS: dict[str, list[str]] = {
    "plain": [],
    "height scan": _SCAN,
    "depth": _DEPTH,
    "terrain": ["scene=rough"],
    "terrain, height scan": ["scene=rough", *_SCAN],
    "terrain, depth": ["scene=rough", *_DEPTH],
}


def beside(num_envs: int, steps: int, overrides: list[str]) -> dict[str, float]:
    """Return the time of an environment step with each added sensor or terrain, ms; blocks of variants alternate."""
    envs: dict[str, ManagerBasedRLEnv] = {}
    for name, words in VARIANTS.items():
        composed = compose([f"env.num_envs={num_envs}", *words, *overrides])
        envs[name] = build_env(composed.config, asset_roots=composed.asset_roots)
        envs[name].reset()
    spent = dict.fromkeys(envs, 0.0)
    todo = actions(envs["plain"], steps + BLOCK)
    with torch.inference_mode():
        for first in range(0, len(todo), BLOCK):
            for name, env in envs.items():
                start = time.perf_counter()
                for action in todo[first : first + BLOCK]:
                    env.step(action)
                if first:  # the first block warms up
                    spent[name] += time.perf_counter() - start
    return {name: 1e3 * value / steps for name, value in spent.items()}


def print_beside(spent: dict[str, float]) -> None:
    """Print how much time each added sensor or terrain costs compared with the plain environment."""
    print("\nenv.step beside the plain one, in turn (ms, ratio):")
    for name, value in spent.items():
        print(f"  {name:24s} {value:7.3f} {value / spent['plain']:7.2f}")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-envs", type=int, default=512)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--beside", action="store_true", help="also with height scans, depth and terrain")
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_args()
    composed = compose([f"env.num_envs={args.num_envs}", *args.overrides])
    torch.set_num_threads(1)
    env = build_env(composed.config, asset_roots=composed.asset_roots)
    env.reset()
    paired(env, 50)
    full, bare = paired(env, args.steps)
    physics = args.steps * env.num_envs * env.decimation
    result: dict[str, Any] = {
        "ratio": bare / full,
        "env_steps_per_s": args.steps * env.num_envs / full,
        "physics_steps_per_s": {"env": physics / full, "bare": physics / bare},
        "ms_per_step": {"env": 1e3 * full / args.steps, "bare": 1e3 * bare / args.steps},
        "num_envs": env.num_envs,
        "threads": env.scene.sim.nthread,
        "breakdown_ms": breakdown(env, args.steps),
    }
    if args.beside:
        result["beside_ms"] = beside(args.num_envs, args.steps, args.overrides)
    if args.json:
        print(json.dumps(result, indent=2))
        return
    print(f"{env.num_envs} environments, decimation {env.decimation}, {result['threads']} physics threads")
    print(f"env.step    {result['ms_per_step']['env']:7.3f} ms   {result['env_steps_per_s']:10.0f} environment steps/s")
    print(f"Batch.step  {result['ms_per_step']['bare']:7.3f} ms")
    print(f"ratio       {result['ratio']:7.3f}      (1 is MuJoCo alone)")
    print("\nwhere a step's time goes (ms):")
    for label, value in sorted(result["breakdown_ms"].items(), key=lambda item: -item[1]):
        print(f"  {label:24s} {value:7.3f}")
    if args.beside:
        print_beside(result["beside_ms"])


if __name__ == "__main__":
    main()
