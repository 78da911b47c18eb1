"""Compare the time of a training with its floor, in one process.

    python benchmarks/training_floor.py [key=value ...]

The floor of an iteration is the time of its physics steps alone, of one forward pass of both networks per control step,
and of the gradient steps of an update: forward, backward, and Adam, on random samples. With a mirror loss, an update
passes each sample through the policy twice. A warm start counts as rollouts without updates. In every tenth iteration,
the physics steps are repeated from the training's own states, because robots that fall or drive need more solver
iterations than robots at rest. The time of the networks is measured before and after the training. Each time is the
median of five.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext

from wheelleg_exp.machine import prepare_threads

prepare_threads()

import torch  # noqa: E402  (thread variables come first)
from rsl_rl.modules import MLP  # noqa: E402

from wheelleg_exp.build import build_env  # noqa: E402
from wheelleg_exp.config.composing.compose import compose  # noqa: E402
from wheelleg_exp.evaluation.lqr_balancer import Reference  # noqa: E402
from wheelleg_exp.rl.matmul import bfloat16_products, chosen_matmul  # noqa: E402
from wheelleg_exp.rl.options import read_agent  # noqa: E402
from wheelleg_exp.rl.trainer import Trainer  # noqa: E402
from wheelleg_exp.rl.vec_env import RslRlVecEnv  # noqa: E402
from wheelleg_exp.sim.batch_engine import BatchEngine  # noqa: E402


def seconds(work: Callable[[], None]) -> float:
    """Return the median duration of five calls, s."""
    took = []
    for _ in range(5):
        start = time.perf_counter()
        work()
        took.append(time.perf_counter() - start)
    return statistics.median(took)


def main() -> None:
    """Train, and print the floor, the time of the training, and their ratio."""
    config = compose(sys.argv[1:] or ["task=stand"]).config
    agent = read_agent(config["agent"])
    torch.set_num_threads(config["agent"]["torch_threads"])
    built = build_env(config)
    env = RslRlVecEnv(built, agent.clip_actions)
    warm_start = config["agent"]["warm_start"]
    trainer = Trainer(env, agent, config["seed"], controller=Reference(built) if warm_start else None)
    count, steps, settings = env.num_envs, agent.num_steps_per_env, config["agent"]["algorithm"]
    samples = count * steps // settings["num_mini_batches"]
    updates = settings["num_learning_epochs"] * settings["num_mini_batches"]
    twice = 2 if (settings.get("symmetry_cfg") or {}).get("use_mirror_loss") else 1
    widths = {name: env.get_observations()[name].shape[1] for name in ("policy", "critic")}
    actor = MLP(widths["policy"], env.num_actions, config["agent"]["actor"]["hidden_dims"])
    critic = MLP(widths["critic"], 1, config["agent"]["critic"]["hidden_dims"])
    engine = built.scene.sim
    assert isinstance(engine, BatchEngine)
    alone = BatchEngine(engine.model, count, engine.nthread)
    adam = torch.optim.Adam([*actor.parameters(), *critic.parameters()])
    # Not zeros: their gradients would be denormal numbers, which are slow.
    policy, value = torch.randn(twice * samples, widths["policy"]), torch.randn(samples, widths["critic"])

    visited: list[torch.Tensor] = []
    step = engine.step

    def record_and_step() -> None:
        if trainer.iteration % 10 == 5:  # not 0, which is also the iteration of a warm start
            visited.append(engine.state.clone())
        step()

    def copying() -> None:
        for state in visited:
            alone.state.copy_(state)

    def physics() -> None:
        for state in visited:
            alone.state.copy_(state)
            alone.step()

    @torch.inference_mode()
    def acting() -> None:
        for _ in range(steps):
            actor(policy[:count])
            critic(value[:count])

    def update() -> None:
        for _ in range(updates):
            loss = (actor(policy) - 1.0).square().mean() + (critic(value) - 1.0).square().mean()
            adam.zero_grad()
            loss.backward()
            adam.step()

    def floor() -> list[float]:
        half = chosen_matmul(agent) == "bfloat16"
        with bfloat16_products([actor, critic]) if half else nullcontext():
            return [seconds(acting), seconds(update)]

    vars(engine)["step"] = record_and_step
    before, repeated, took, start = floor(), [], 0.0, time.perf_counter()
    for _ in trainer.learn(agent.max_iterations):
        took += time.perf_counter() - start
        if visited:
            repeated.append(seconds(physics) - seconds(copying))
            visited.clear()
        start = time.perf_counter()
    networks = [(a + b) / 2 for a, b in zip(before, floor(), strict=True)]
    rollouts = agent.max_iterations + warm_start
    counts = (rollouts, rollouts, agent.max_iterations)
    parts = [n * part for n, part in zip(counts, (statistics.mean(repeated), *networks), strict=True)]
    names = ("physics", "acting", "update")
    print(", ".join(f"{name} {part:.1f} s" for name, part in zip(names, parts, strict=True)))
    print(f"floor {sum(parts):.1f} s, training {took:.1f} s: {took / sum(parts):.2f} times the floor")


if __name__ == "__main__":
    main()
