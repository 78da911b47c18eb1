"""Check whether mujoco-warp repeats a simulation bit for bit, and name the first quantity that differs.

    python benchmarks/gpu_repeat.py [--device cuda:0] [--num-envs 4096] [--modes fixed none atomics all sorted exact]
        [--steps 1000] [-- overrides ...]

The mode ``fixed`` is ``env.sim.deterministic=true``; ``none``, ``atomics``, and ``all`` are values of mujoco-warp's
``opt.deterministic``. The modes ``sorted`` and ``exact`` add the sorts of ``gpu_sorted.py``, without and with exact
sums, and launch each kernel separately. The start is a state in which robots stand, fall and lie.

For each mode, the script first repeats one physics step ``--repeats`` times from this state, and lists each quantity
that differs, in the order in which a step computes them. Contacts and rows are compared as they are and sorted: if only
the first differ, their order is the cause. Then it makes ``--steps`` physics steps twice with the same random controls.
If these runs differ, it repeats the first differing step in the same way. Finally, it makes ``--env-steps`` environment
steps twice, with the same random actions, if the mode is ``fixed``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from typing import Any

from wheelleg_exp.machine import prepare_threads

prepare_threads()

import mujoco  # noqa: E402  (thread variables come first)
import torch  # noqa: E402
from gpu_sorted import fill_the_sorts  # noqa: E402

from wheelleg_exp.build import build_env  # noqa: E402
from wheelleg_exp.config.composing.compose import compose  # noqa: E402
from wheelleg_exp.sim.warp_engine import WarpEngine  # noqa: E402

MODES = ("fixed", "none", "atomics", "all", "sorted", "exact")  # The order matters: added sorts stay active.
WARM = 60
# The quantities of a step in the order in which mujoco-warp computes them; rows and contacts come after the first.
BEFORE = ("geom_xpos", "geom_xmat", "cdof", "cinert", "M")
AFTER = ("actuator_moment", "cvel", "qfrc_bias", "qfrc_passive", "qfrc_actuator", "qfrc_smooth", "qacc_smooth")
SOLVED = ("solver_niter", "qfrc_constraint", "qacc", "sensordata", "qvel", "qpos")
ROWS = ("type", "J", "pos", "margin", "D", "vel", "aref", "frictionloss", "force", "state")
CONTACTS = ("geom", "geomcollisionid", "dist", "pos", "frame", "friction", "solref", "solimp", "dim", "type")


def snapshot(engine: WarpEngine) -> dict[str, torch.Tensor]:
    """Return the quantities of the last physics step, (N, ...), in the order of their computation."""
    data, view = engine._d, engine._wp.to_torch
    found = {name: view(getattr(data, name)).clone() for name in BEFORE}
    contact, count = data.contact, min(int(view(data.nacon)), data.naconmax)
    world = view(contact.worldid)[:count].long()
    geom = view(contact.geom)[:count].long()
    key = ((geom[:, 0] << 24) + geom[:, 1] << 8) + view(contact.geomcollisionid)[:count]
    per_world = torch.bincount(world, minlength=engine.num_envs)
    found["number of contacts"] = per_world
    for how, order in (("", torch.arange(count, device=world.device)), (", sorted", torch.argsort(key, stable=True))):
        order = order[torch.argsort(world[order], stable=True)]
        place = torch.arange(count, device=world.device) - (per_world.cumsum(0) - per_world)[world[order]]
        for name in CONTACTS:
            values = view(getattr(contact, name))[:count][order]
            shape = (engine.num_envs, int(per_world.amax()) if count else 0, *values.shape[1:])
            found[f"contact.{name}{how}"] = values.new_zeros(shape).index_put_((world[order], place), values)
    rows = view(data.nefc).long()
    found["number of rows"] = rows
    width = data.efc.type.shape[1]
    index = torch.arange(width, device=rows.device).expand(len(rows), width)
    used = index < rows.view(-1, 1)
    kind, number = view(data.efc.type).long(), view(data.efc.id).long()
    of_contact = kind >= int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)
    if count:
        number = torch.where(of_contact & used, key[number.clamp(0, count - 1)], number)
    row_key = torch.where(used, (kind << 52) + number, torch.iinfo(torch.int64).max)
    for how, order in (("", index), (", sorted", torch.argsort(row_key, dim=1, stable=True))):
        for name in ROWS:
            values = view(getattr(data.efc, name))[:, :width]
            by = order.view(*order.shape, *[1] * (values.ndim - 2)).expand(-1, -1, *values.shape[2:])
            mask = used.view(*used.shape, *[1] * (values.ndim - 2))
            found[f"row.{name}{how}"] = torch.where(mask, values.gather(1, by), 0)
    for name in (*AFTER, *SOLVED):
        found[name] = view(getattr(data, name)).clone()
    # The solver runs after the smooth forces, so its results come after them.
    late = [name for name in found if name.startswith(("row.force", "row.state"))]
    return {n: found[n] for n in [*(n for n in found if n not in (*late, *SOLVED)), *late, *SOLVED]}


def differing(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Return the numbers of the simulations in which two tensors differ; NaN equals NaN."""
    if one.shape != other.shape:
        return torch.arange(len(one))
    unlike = (one != other) & ~((one != one) & (other != other))
    return unlike.reshape(len(one), -1).any(dim=1).nonzero()[:, 0]


def repeat_one_step(engine: WarpEngine, state: Mapping[str, Any], repeats: int) -> None:
    """Repeat one physics step from a state, and print which quantities differ."""
    worst: dict[str, tuple[int, list[int], float, int]] = {}
    reference: dict[str, torch.Tensor] = {}
    for index in range(repeats + 1):
        engine.load_state_dict(state)
        engine.step()
        found = snapshot(engine)
        if not index:
            reference = found
            continue
        for name, values in found.items():
            worlds = differing(reference[name], values)
            if not len(worlds):
                continue
            largest = float("inf")
            if values.shape == reference[name].shape:
                largest = float((values.double() - reference[name].double()).abs().nan_to_num(0.0).max())
            before = worst.get(name, (0, [], 0.0, 0))
            ids = before[1] or worlds[:6].tolist()
            worst[name] = (max(before[0], len(worlds)), ids, max(before[2], largest), before[3] + 1)
    for name in reference:
        if name in worst:
            count, ids, largest, times = worst[name]
            print(f"    {name}: {count} worlds in {times} of {repeats} repeats, by {largest:.3g}, e.g. {ids}")
    if not worst:
        print(f"    no quantity differs in {repeats} repeats of one step")


def trajectories(engine: WarpEngine, state: Mapping[str, Any], steps: int, repeats: int) -> None:
    """Make physics steps twice from a state with the same random controls, and inspect the first difference."""
    ctrl, scale = engine.view("ctrl"), engine.view("ctrl").abs().mean().clamp(min=0.1)
    noise = torch.randn(64, *ctrl.shape, generator=torch.Generator().manual_seed(1)).to(ctrl.device) * scale
    states: list[torch.Tensor] = []
    unlike = torch.zeros(steps, dtype=torch.long, device=ctrl.device)
    contacts = torch.zeros(steps, dtype=torch.long, device=ctrl.device)
    for run in range(2):
        engine.load_state_dict(state)
        for _ in range(10):  # Compile and capture first.
            engine.step()
        engine.load_state_dict(state)
        torch.cuda.synchronize() if ctrl.is_cuda else None
        start = time.perf_counter()
        for index in range(steps):
            ctrl.copy_(noise[index % 64])
            engine.step()
            if run:
                unlike[index] = ((engine.state != states[index]).any(dim=1)).sum()
                contacts[index] = engine._wp.to_torch(engine._d.nacon)[0]
            else:
                states.append(engine.state)
        torch.cuda.synchronize() if ctrl.is_cuda else None
        spent = time.perf_counter() - start
    first = int((unlike > 0).nonzero()[0]) if bool((unlike > 0).any()) else None
    print(
        f"  {steps} steps: {int(unlike[-1])} of {engine.num_envs} worlds differ at the end, the first at step {first};"
        f" {float(contacts.double().mean()) / engine.num_envs:.1f} contacts per world, {1e3 * spent / steps:.3f} ms"
    )
    if first is not None:
        engine.load_state_dict(state)
        for index in range(first):
            ctrl.copy_(noise[index % 64])
            engine.step()
        ctrl.copy_(noise[first % 64])
        print("  the first differing step:")
        repeat_one_step(engine, engine.state_dict(), repeats)


def environment_steps(env: Any, steps: int) -> None:
    """Make environment steps twice with the same actions, and print the first result that differs."""
    saved, width = env.state_dict(), env.action_manager.total_action_dim
    actions = 0.5 * torch.randn(64, env.num_envs, width, generator=torch.Generator().manual_seed(2)).to(env.device)
    results: list[dict[str, torch.Tensor]] = []
    for run in range(2):
        env.load_state_dict(saved)
        for index in range(steps):
            observations, reward, terminated, timed_out, _ = env.step(actions[index % 64])
            result = {**observations, "reward": reward, "terminated": terminated, "timed out": timed_out}
            result = {name: value.clone() for name, value in result.items()} | {"state": env.scene.sim.state}
            if not run:
                results.append(result)
                continue
            if names := [name for name, value in result.items() if len(differing(results[index][name], value))]:
                print(f"  environment step {index}: different {', '.join(names)}")
                return
    print(f"  {steps} environment steps are equal")


def check(mode: str, args: argparse.Namespace, num_envs: int) -> None:
    """Build the environment for a mode, and print the three comparisons."""
    start = time.perf_counter()
    words = [*args.overrides, "env.sim.engine=warp", f"env.sim.device={args.device}", f"env.num_envs={num_envs}"]
    words += ["env.sim.deterministic=true"] if mode == "fixed" else []
    words += ["env.sim.graph=false"] if mode in ("sorted", "exact") else []
    composed = compose(words)
    env = build_env(composed.config, asset_roots=composed.asset_roots)
    env.reset()
    engine = env.scene.sim
    assert isinstance(engine, WarpEngine)
    kinds = engine._mjw.DeterminismType
    sorts = int(kinds.CONTACTS | kinds.CONSTRAINT)
    if mode in ("sorted", "exact"):
        fill_the_sorts(engine._wp)
    if mode != "fixed":
        values = {"none": 0, "atomics": 0, "all": sorts, "sorted": sorts, "exact": sorts}
        atomics = int(kinds.ATOMICS) if mode in ("atomics", "all", "exact") else 0
        engine._m.opt.deterministic = values[mode] | atomics
    generator = torch.Generator().manual_seed(0)
    for _ in range(WARM):
        action = 0.3 * torch.randn(num_envs, env.action_manager.total_action_dim, generator=generator)
        env.step(action.to(env.device))
    print(f"{mode}, {num_envs} worlds, {' '.join(args.overrides)}: built in {time.perf_counter() - start:.0f} s")
    state = engine.state_dict()
    repeat_one_step(engine, state, args.repeats)
    trajectories(engine, state, args.steps if mode not in ("sorted", "exact") else min(args.steps, 50), args.repeats)
    if mode == "fixed":
        environment_steps(env, args.env_steps)
    print(f"  done after {time.perf_counter() - start:.0f} s", flush=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--num-envs", type=int, nargs="+", default=[4096])
    parser.add_argument("--modes", nargs="+", default=["fixed"], choices=MODES)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--env-steps", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("overrides", nargs="*", default=["task=stand"])
    args = parser.parse_args()
    for mode in sorted(args.modes, key=MODES.index):
        for num_envs in args.num_envs:
            check(mode, args, num_envs)


if __name__ == "__main__":
    main()
