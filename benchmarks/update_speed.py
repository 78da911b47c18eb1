"""How long the update takes: stock rsl_rl's PPO, and ours, in turn, in one process.

    python benchmarks/update_speed.py [--envs 512] [--rounds 5] [--threads 2] [--matmul auto] [key=value ...]

The networks, their inputs, minibatches and epochs are those of the composed config; observations, rewards and
episodes' ends are drawn, because the time does not depend on them. CPU time is told beside wall clock: on a busy
machine it is steadier. ``--matmul float32`` measures ours without bfloat16.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import io
import json
import os
import statistics
import time
from types import SimpleNamespace
from typing import Any

from wheelleg_exp.threads import prepare_threads

prepare_threads()

import torch  # noqa: E402  (thread variables come first)
from rsl_rl.algorithms import PPO  # noqa: E402
from tensordict import TensorDict  # noqa: E402

from wheelleg_exp.config.composing.compose import compose  # noqa: E402
from wheelleg_exp.jobs.threads import mkl_in_force  # noqa: E402
from wheelleg_exp.rl.matmul import bfloat16_products, chosen_matmul  # noqa: E402

SECTIONS = ("num_steps_per_env", "obs_groups", "algorithm", "actor", "critic")
WIDTHS = {"policy": 135, "critic": 180}  # of the observations of task=stand
ACTIONS = 6


def observations(envs: int) -> TensorDict:
    """Return drawn observations."""
    return TensorDict({name: torch.randn(envs, width) for name, width in WIDTHS.items()}, batch_size=[envs])


def stock(agent: dict[str, Any], envs: int) -> PPO:
    """Return rsl_rl's own algorithm."""
    torch.manual_seed(0)
    config = copy.deepcopy({name: agent[name] for name in SECTIONS}) | {"multi_gpu": None}
    with contextlib.redirect_stdout(io.StringIO()):
        return PPO.construct_algorithm(
            observations(envs), SimpleNamespace(num_envs=envs, num_actions=ACTIONS), config, "cpu"
        )


@torch.inference_mode()
def roll_out(algorithm: PPO, envs: int, steps: int) -> None:
    """Fill the algorithm's storage."""
    for _ in range(steps):
        obs = observations(envs)
        algorithm.act(obs)
        algorithm.process_env_step(obs, torch.randn(envs), torch.rand(envs) < 0.01, {})
    algorithm.compute_returns(observations(envs))


def timed(algorithm: PPO, matmul: str) -> tuple[float, float]:
    """Update, and return seconds of wall clock and of CPU time."""
    networks = [algorithm.actor, algorithm.critic]
    with bfloat16_products(networks) if matmul == "bfloat16" else contextlib.nullcontext():
        start, cpu = time.perf_counter(), time.process_time()
        algorithm.update()
        return time.perf_counter() - start, time.process_time() - cpu


def main() -> None:
    """Measure both and print medians and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", type=int, default=512)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2, help="of torch")
    parser.add_argument("--matmul", choices=["auto", "float32", "bfloat16"], default="auto")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("overrides", nargs="*", help="key=value of the config")
    args = parser.parse_args()
    agent = compose(["task=stand", *args.overrides]).config["agent"]
    torch.set_num_threads(args.threads)
    matmul = chosen_matmul({**agent, "matmul": args.matmul})
    plain = stock(agent, args.envs)
    ours = stock(agent, args.envs)
    found: dict[str, list[tuple[float, float]]] = {"stock": [], "ours": []}
    for number in range(args.rounds + 1):
        for name, algorithm, kind in (("stock", plain, "float32"), ("ours", ours, matmul)):
            torch.manual_seed(number)
            roll_out(algorithm, args.envs, int(agent["num_steps_per_env"]))
            took = timed(algorithm, kind)
            if number:  # the first warms up
                found[name].append(took)
    facts: dict[str, Any] = {
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "mkl": mkl_in_force(),
        "matmul": matmul,
        "threads": args.threads,
        "envs": args.envs,
        "load": os.getloadavg()[0],
    }
    for index, kind in enumerate(("wall", "cpu")):
        medians = {name: statistics.median(run[index] for run in runs) for name, runs in found.items()}
        facts[kind] = medians | {"ratio": medians["ours"] / medians["stock"]}
    if args.json:
        print(json.dumps(facts))
        return
    print(", ".join(f"{name} {facts[name]}" for name in ("matmul", "threads", "envs", "cpu_capability", "mkl", "load")))
    for kind in ("wall", "cpu"):
        seconds = facts[kind]
        print(f"{kind:>5}: stock {seconds['stock']:.3f} s, ours {seconds['ours']:.3f} s, ratio {seconds['ratio']:.3f}")


if __name__ == "__main__":
    main()
