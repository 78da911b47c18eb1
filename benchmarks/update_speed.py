"""Compare the time of a PPO update of stock rsl_rl with an update of this project, alternating in one process.

    python benchmarks/update_speed.py [--envs 512] [--rounds 5] [--threads 2] [--matmul auto] [key=value ...]
    python benchmarks/update_speed.py --modes [--counts 1,2,4,8] [--rounds 3]

The networks, inputs, minibatches and epochs come from the composed config. The observations, rewards and episode ends
are random, because the time does not depend on their values. The script prints CPU time in addition to wall-clock time,
because CPU time is steadier on a busy computer. ``--matmul float32`` measures this project's update without bfloat16.

``--modes`` runs this project's update in separate processes with each repeatable code path of MKL, each number format
and several numbers of threads, and prints which combinations give equal weights bit for bit.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import hashlib
import io
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

from wheelleg_exp.machine import PORTABLE_KERNELS, WIDE_KERNELS, prepare_threads
from wheelleg_exp.rl.options import read_agent

prepare_threads()

import torch  # noqa: E402  (thread variables come first)
from rsl_rl.algorithms import PPO  # noqa: E402
from tensordict import TensorDict  # noqa: E402

from wheelleg_exp.config.composing.compose import compose  # noqa: E402
from wheelleg_exp.jobs.torch_threads import mkl_in_force  # noqa: E402
from wheelleg_exp.rl.matmul import bfloat16_products, chosen_matmul  # noqa: E402

SECTIONS = ("num_steps_per_env", "obs_groups", "algorithm", "actor", "critic")
WIDTHS = {"policy": 135, "critic": 180}  # The observation widths of task=stand.
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
    """Run one update, and return the seconds of wall-clock time and of CPU time."""
    networks = [algorithm.actor, algorithm.critic]
    with bfloat16_products(networks) if matmul == "bfloat16" else contextlib.nullcontext():
        start, cpu = time.perf_counter(), time.process_time()
        algorithm.update()
        return time.perf_counter() - start, time.process_time() - cpu


def digest(algorithm: PPO) -> str:
    """Return a digest of the networks' weights and the optimiser's state."""
    found = hashlib.sha256()
    means = [t for state in algorithm.optimizer.state.values() for t in state.values()]
    for tensor in [*algorithm.actor.parameters(), *algorithm.critic.parameters(), *means]:
        found.update(tensor.detach().numpy().tobytes())
    return found.hexdigest()[:12]


def measure(args: argparse.Namespace, names: Sequence[str]) -> dict[str, Any]:
    """Return the median seconds of each named update (``stock``, ``ours``), and the settings of the measurement."""
    agent = compose(["task=stand", *args.overrides]).config["agent"]
    torch.set_num_threads(args.threads)
    matmul = chosen_matmul(read_agent({**agent, "matmul": args.matmul}))
    kinds = {"stock": "float32", "ours": matmul}
    algorithms = {name: stock(agent, args.envs) for name in names}
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    for number in range(args.rounds + 1):
        for name, algorithm in algorithms.items():
            torch.manual_seed(number)
            roll_out(algorithm, args.envs, int(agent["num_steps_per_env"]))
            took = timed(algorithm, kinds[name])
            if number:  # the first warms up
                found[name].append(took)
    facts: dict[str, Any] = {
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "mkl": mkl_in_force(),
        "matmul": matmul,
        "threads": args.threads,
        "envs": args.envs,
        "load": os.getloadavg()[0],
        "digest": {name: digest(algorithm) for name, algorithm in algorithms.items()},
    }
    for index, kind in enumerate(("wall", "cpu")):
        facts[kind] = {name: statistics.median(run[index] for run in runs) for name, runs in found.items()}
        if len(names) == 2:
            facts[kind]["ratio"] = facts[kind]["ours"] / facts[kind]["stock"]
    return facts


def compare_modes(args: argparse.Namespace) -> None:
    """Print seconds and digests of this project's update for each code path, number format and number of threads."""
    counts = [int(count) for count in args.counts.split(",")]
    for kernels in (PORTABLE_KERNELS, WIDE_KERNELS):
        for matmul in ("float32", "bfloat16"):
            runs = []
            for count in counts:
                command = [sys.executable, __file__, "--alone", "--json", f"--threads={count}", f"--matmul={matmul}"]
                command += [f"--envs={args.envs}", f"--rounds={args.rounds}", *args.overrides]
                environ = os.environ | {"MKL_CBWR": kernels}
                done = subprocess.run(command, env=environ, stdout=subprocess.PIPE, text=True, check=True)
                runs.append(json.loads(done.stdout.splitlines()[-1]))
            digests = [run["digest"]["ours"] for run in runs]
            seconds = " ".join(f"{count}: {run['wall']['ours']:.3f}" for count, run in zip(counts, runs, strict=True))
            said = "equal to the bit" if len(set(digests)) == 1 else "DIFFERENT " + " ".join(digests)
            print(f"{kernels} {matmul:>8}, s by threads {seconds}, weights {said}", flush=True)


def main() -> None:
    """Measure both updates and print the medians and their ratio, or compare modes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", type=int, default=512)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2, help="of torch")
    parser.add_argument("--matmul", choices=["auto", "float32", "bfloat16"], default="auto")
    parser.add_argument("--modes", action="store_true", help="compare code paths, products and numbers of threads")
    parser.add_argument("--counts", default="1,2,4,8", help="numbers of threads that --modes compares")
    parser.add_argument("--alone", action="store_true", help="ours without the stock one")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("overrides", nargs="*", help="key=value of the config")
    args = parser.parse_args()
    if args.modes:
        compare_modes(args)
        return
    facts = measure(args, ["ours"] if args.alone else ["stock", "ours"])
    if args.json or args.alone:
        print(json.dumps(facts))
        return
    print(", ".join(f"{name} {facts[name]}" for name in ("matmul", "threads", "envs", "cpu_capability", "mkl", "load")))
    for kind in ("wall", "cpu"):
        seconds = facts[kind]
        print(f"{kind:>5}: stock {seconds['stock']:.3f} s, ours {seconds['ours']:.3f} s, ratio {seconds['ratio']:.3f}")


if __name__ == "__main__":
    main()
