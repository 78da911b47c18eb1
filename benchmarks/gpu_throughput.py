"""Compare the speed of ``env.step`` on mujoco-warp with mujoco-warp alone, and measure a training iteration.

    python benchmarks/gpu_throughput.py [--num-envs 512 4096 16384] [--steps 200] [--device cuda:0] [--json FILE]
        [--train] [--profile] [overrides ...]

Blocks of environment steps alternate with bare physics steps of the same model, buffer sizes, states and controls; the
physics steps of one control step are one CUDA graph. ``--train`` also measures training iterations. ``--profile`` also
counts the kernels of one environment step and the waits of the host for the device. For a trial without a GPU, use
``--device cpu`` and few environments.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
import warnings
from functools import partial
from pathlib import Path
from typing import Any

from wheelleg_exp.machine import prepare_threads
from wheelleg_exp.rl.options import read_agent

prepare_threads()

import torch  # noqa: E402  (thread variables come first)
from step_parts import time_parts  # noqa: E402

from wheelleg_exp.build import build_env  # noqa: E402
from wheelleg_exp.config.composing.compose import compose  # noqa: E402
from wheelleg_exp.env import ManagerBasedRLEnv  # noqa: E402
from wheelleg_exp.sim.warp_engine import WarpEngine  # noqa: E402

BLOCK = 20  # The number of steps in a block.
WARM_UP, MOST_WARM_UP = 30, 3000  # Graphs of frequent reset counts are captured late.


def now(device: torch.device) -> float:
    """Wait until the device has finished all launched work, and return the current time, s."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


class Bare:
    """mujoco-warp alone: the physics steps of one control step, in one graph on a GPU."""

    def __init__(self, env: ManagerBasedRLEnv) -> None:
        engine = env.scene.sim
        assert isinstance(engine, WarpEngine)
        self._engine, self._env = engine, env
        self._wp, mjw = engine._wp, engine._mjw
        room, place = engine.room, engine._graphs.place
        with self._wp.ScopedDevice(place):
            model = mjw.put_model(engine.model)
            model.opt.warn_overflow = 0
            model.opt.contact_sensor_maxmatch = engine._m.opt.contact_sensor_maxmatch
            self.data = mjw.make_data(engine.model, nworld=env.num_envs, nconmax=room.contacts, njmax=room.rows)

            def steps() -> None:
                for _ in range(env.decimation):
                    mjw.step(model, self.data)

            self._steps, self._graph = steps, None
            self.take_states()
            steps()
            if env.device.type == "cuda":
                with self._wp.ScopedCapture(place) as capture:
                    steps()
                self._graph = capture.graph

    def take_states(self) -> None:
        """Copy the current states and controls of the environments."""
        for name in ("qpos", "qvel", "ctrl", "xfrc_applied", "qacc_warmstart"):
            self._wp.to_torch(getattr(self.data, name)).view_as(self._engine.view(name)).copy_(self._engine.view(name))

    def step(self) -> None:
        """Simulate the physics steps of one control step."""
        if self._graph is None:
            with self._wp.ScopedDevice(self._engine._graphs.place):
                self._steps()
        else:
            self._wp.capture_launch(self._graph)


def actions(env: ManagerBasedRLEnv, steps: int) -> list[torch.Tensor]:
    """Return small random actions, so that episodes end at many different times."""
    generator = torch.Generator().manual_seed(0)
    shape = (env.num_envs, env.action_manager.total_action_dim)
    return [(0.3 * torch.randn(shape, generator=generator)).to(env.device) for _ in range(min(steps, 2 * BLOCK))]


def warm_up(env: ManagerBasedRLEnv, todo: list[torch.Tensor]) -> None:
    """Step the environment until no new CUDA graph is captured."""
    captured, steps = None, 0
    while steps < WARM_UP or (env.scene.sim.is_captured and steps < MOST_WARM_UP):
        env.step(todo[steps % len(todo)])
        steps += 1
        if steps % (10 * WARM_UP) == 0:
            parts = env.graph_capture.parts if env.graph_capture else {}
            before, captured = captured, sum(len(part.recordings) for part in parts.values())
            if captured == before:
                break


def paired(env: ManagerBasedRLEnv, steps: int) -> tuple[float, float]:
    """Return the seconds per step in ``env.step`` and in bare physics, as medians of alternating blocks."""
    bare, todo = Bare(env), actions(env, WARM_UP)
    full_times, bare_times = [], []
    with torch.inference_mode():
        warm_up(env, todo)
        for _ in range(max(1, steps // BLOCK)):
            bare.take_states()
            start = now(env.device)
            for index in range(BLOCK):
                env.step(todo[index % len(todo)])
            middle = now(env.device)
            for _ in range(BLOCK):
                bare.step()
            end = now(env.device)
            full_times.append((middle - start) / BLOCK)
            bare_times.append((end - middle) / BLOCK)
    return sorted(full_times)[len(full_times) // 2], sorted(bare_times)[len(bare_times) // 2]


def parts(env: ManagerBasedRLEnv, steps: int) -> dict[str, float]:
    """Return the time of each part of a step, ms; the sum exceeds a step, because the host waits after each part."""
    spent = time_parts(env, partial(now, env.device))
    todo = actions(env, steps)
    with torch.inference_mode():
        for index in range(steps):
            env.step(todo[index % len(todo)])
    return {label: 1e3 * value / steps for label, value in sorted(spent.items(), key=lambda item: -item[1])}


def profile(env: ManagerBasedRLEnv) -> dict[str, Any]:
    """Return how many kernels one step launches, and where the host waits for the device."""
    todo, count = actions(env, BLOCK), 5
    with torch.inference_mode(), torch.profiler.profile() as seen:
        for index in range(count):
            env.step(todo[index])
        now(env.device)
    on_device = [e for e in seen.events() if e.device_type == torch.profiler.DeviceType.CUDA]
    copies = [e for e in on_device if "memcpy" in e.name.lower()]
    waits: list[str] = []
    if env.device.type == "cuda":
        torch.cuda.set_sync_debug_mode("warn")
        with torch.inference_mode(), warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            env.step(todo[0])
        torch.cuda.set_sync_debug_mode("default")
        waits = [f"{Path(w.filename).name}:{w.lineno}" for w in told]
    calls = {e.key: e.count for e in seen.key_averages()}
    launches = sum(count for name, count in calls.items() if "LaunchKernel" in name)
    graphs = sum(count for name, count in calls.items() if "GraphLaunch" in name)
    return {
        "kernels": len(on_device) / count,
        "copies": len(copies) / count,
        "launches": launches / count,
        "graph_launches": graphs / count,
        "waits": waits,
    }


def train(overrides: list[str], num_envs: int, device: str, iterations: int) -> dict[str, float]:
    """Return the median seconds of the rollout and of the update of an iteration, and the environment steps/s."""
    from wheelleg_exp.rl.trainer import Trainer
    from wheelleg_exp.rl.vec_env import RslRlVecEnv

    composed = compose([*overrides, f"env.num_envs={num_envs}", f"agent.device={device}"])
    env = build_env(composed.config, asset_roots=composed.asset_roots)
    agent = read_agent(composed.config["agent"])
    trainer = Trainer(RslRlVecEnv(env, agent.clip_actions), agent, 0)
    collected, learned = [], []
    for done in trainer.learn(until=iterations):
        if done.index >= iterations // 2:
            collected.append(done.scalars["Perf/collection_time"])
            learned.append(done.scalars["Perf/learning_time"])
    rollout, update = (sorted(times)[len(times) // 2] for times in (collected, learned))
    steps = trainer.num_steps * num_envs
    return {"rollout_s": rollout, "update_s": update, "env_steps_per_s": steps / (rollout + update)}


def machine(device: torch.device) -> dict[str, Any]:
    """Return the versions of the packages, and the name of the device."""
    found: dict[str, Any] = {"python": platform.python_version(), "torch": torch.__version__}
    for name in ("mujoco", "mujoco_warp", "warp"):
        found[name] = __import__(name).__version__
    found["device"] = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor()
    return found


def measure(num_envs: int, args: argparse.Namespace) -> dict[str, Any]:
    """Measure and print the speed for one number of environments."""
    overrides = ["env.sim.engine=warp", f"env.sim.device={args.device}", *args.overrides]
    composed = compose([*overrides, f"env.num_envs={num_envs}"])
    start = time.perf_counter()
    env = build_env(composed.config, asset_roots=composed.asset_roots)
    env.reset()
    engine = env.scene.sim
    assert isinstance(engine, WarpEngine)
    full, bare = paired(env, args.steps)
    result: dict[str, Any] = {
        "num_envs": num_envs,
        "env_ms": 1e3 * full,
        "bare_ms": 1e3 * bare,
        "env_steps_per_s": num_envs / full,
        "bare_env_steps_per_s": num_envs / bare,
        "ratio": bare / full,
        "first_s": time.perf_counter() - start,
        "room": [engine.room.contacts, engine.room.rows],
        "contacts": int(engine._d.nacon.numpy()[0]) / num_envs,
        "most_rows": int(engine._d.nefc.numpy().max()),
    }
    if env.device.type == "cuda":
        result["memory_gb"] = (torch.cuda.mem_get_info()[1] - torch.cuda.mem_get_info()[0]) / 1e9
    print(f"\n{num_envs} environments, decimation {env.decimation}")
    print(f"  env.step  {result['env_ms']:8.3f} ms  {result['env_steps_per_s']:12,.0f} environment steps/s")
    print(f"  bare      {result['bare_ms']:8.3f} ms  {result['bare_env_steps_per_s']:12,.0f}")
    print(f"  ratio     {result['ratio']:8.3f}     (1 is mujoco-warp alone)")
    print("  " + ", ".join(f"{k} {result[k]}" for k in ("room", "contacts", "most_rows", "first_s")), flush=True)
    if args.profile:
        result["profile"] = profile(env)
        result["parts_ms"] = parts(env, BLOCK)
        print("  one step: " + ", ".join(f"{k} {v}" for k, v in result["profile"].items()))
        for label, value in result["parts_ms"].items():
            print(f"    {label:24s} {value:8.3f} ms", flush=True)
    if args.train:
        result["train"] = train(overrides, num_envs, args.device, args.iterations)
        words = ", ".join(f"{name} {value:,.3f}" for name, value in result["train"].items())
        print(f"  training: {words}", flush=True)
    return result


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-envs", type=int, nargs="+", default=[512, 4096, 16384])
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--train", action="store_true")
    parser.add_argument("--iterations", type=int, default=10, help="of each training")
    parser.add_argument("--profile", action="store_true")
    parser.add_argument("--json", type=Path)
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_args()
    torch.set_num_threads(1)
    found: dict[str, Any] = {"machine": machine(torch.device(args.device)), "sizes": []}
    print(found["machine"])
    for num_envs in args.num_envs:
        found["sizes"].append(measure(num_envs, args))
    if args.json:
        args.json.write_text(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
