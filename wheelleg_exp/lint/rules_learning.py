"""Rules about what can be learned: sizes of rewards against each other, discount, batch, and curricula."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from wheelleg_exp.lint.reward_tolerances import (
    FAILURES,
    TRACKING,
    Contribution,
    command_size,
    contributions,
    earned_per_second,
    tracked,
)
from wheelleg_exp.lint.rule import Case, Finding, TermView, above, at_least, at_most, largest, rule

_AUDIBLE = 0.01  # share of what a perfect robot earns that an error should cost
_OUTWEIGHS = 4.0  # times what all rewards earn
_STILL = 0.5  # score of a robot that does not move, above which a std cannot tell
_UNIT = {"lin": "m/s", "ang": "rad/s"}


def still_score(speed: float, std: float) -> float:
    """Return the mean of exp(-c²/std²) over commands c uniform in ±speed: what standing still earns.

    The integral is sqrt(pi)/2 · erf(V/std) · std/V.
    """
    if speed == 0.0:
        return 1.0
    return math.sqrt(math.pi) / 2 * math.erf(speed / std) * std / speed


@rule
def tracking_std(case: Case) -> Iterator[Finding]:
    """A tracking reward so wide that a robot which does not follow earns most of it.

    Over commands uniform in ±V a robot that stands still earns sqrt(pi)/2 · erf(V/std) · std/V of the reward,
    shares of standing commands left out. Where nothing but zero is commanded, it is a drift of one unit of wheel
    action that must not earn it. Source: the integral of the reward's own formula.
    """
    for term in tracked(case):
        std, size = float(term.node["std"]), command_size(case, term)
        finding = _moving(case, term, std, size) if size > 0.0 else _drifting(case, term, std)
        if finding is not None:
            yield finding


@rule
def reward_outweighs(case: Case) -> Iterator[Finding]:
    """A cost that outweighs all that can be earned while the actions are random, as they are when training begins.

    What the policy learns first is then to lower this cost, if by ending the episode. Only `wheelleg doctor task=…`
    tries it. Source: the mean of each term over two seconds of standard normal actions in 32 environments.
    """
    trial = case.trial or {}
    earned = sum(value for value in trial.values() if value > 0.0)
    for term in case.terms("rewards"):
        cost = -trial.get(term.name, 0.0)
        if term.kind in FAILURES or cost <= _OUTWEIGHS * earned:
            continue
        weight = float(term.node["weight"])
        key, right = f"{term.path}.weight", at_most(abs(weight) * _OUTWEIGHS * earned / cost, 2)
        times = f"{cost / earned:.2g} times" if earned > 0.0 else "and nothing earns any of"
        yield Finding(
            key,
            f"costs {cost:.3g} per second under random actions, {times} the {earned:.3g} that all rewards earn",
            f"a weight near {math.copysign(right, weight):g}, or smaller scales of actions",
            {"cost_per_s": cost, "earned_per_s": earned},
        )


def _moving(case: Case, term: TermView, std: float, size: float) -> Finding | None:
    unit, score, narrow = _UNIT[TRACKING[term.kind]], still_score(size, std), at_most(size / 2)
    if score < _STILL:
        return None
    standing = float(case.env["commands"][term.node["command_name"]].get("rel_standing_envs", 0.0))
    return Finding(
        f"{term.path}.std",
        f"with std {std:g} {unit} and commands in ±{size:g} {unit} a robot that never moves earns {score:.2f} of the "
        f"reward ({score + standing * (1 - score):.2f} with {100 * standing:.0f} % standing commands)",
        f"a std near {narrow:g} {unit} leaves it {still_score(size, narrow):.2f}",
        {"std": std, "range": size, "still": score},
        ({f"{term.path}.std": narrow},),
    )


def _drifting(case: Case, term: TermView, std: float) -> Finding | None:
    kind = TRACKING[term.kind]
    drift = _unit_speed(case)
    if kind == "ang":
        drift = 2 * drift / case.facts.track if case.facts.track else 0.0
    score = math.exp(-((drift / std) ** 2))
    if drift == 0.0 or score < _STILL:
        return None
    off = "; its weight is 0 here" if float(term.node["weight"]) == 0.0 else ""
    narrow = at_most(drift)
    return Finding(
        f"{term.path}.std",
        f"nothing but zero is commanded: standing still earns all of it, and with std {std:g} {_UNIT[kind]} a drift of "
        f"{drift:.2g} {_UNIT[kind]}, one unit of wheel action, still earns {score:.2f}{off}",
        f"a std near {narrow:g} {_UNIT[kind]} or below",
        {"std": std, "range": 0.0, "drift": drift, "still": 1.0, "drifting": score},
        ({f"{term.path}.std": narrow},),
    )


def _unit_speed(case: Case) -> float:
    """Return the speed at one unit of wheel action, m/s; a tenth of the top speed without such an action."""
    for action in case.terms("actions", "actions.JointVelocityAction"):
        scales = case.by_joint(action.node.get("scale", 1.0), list(case.joints(action.node)), 1.0)
        driven = [abs(float(scale)) for name, scale in scales.items() if name in case.facts.wheels]
        if driven:
            return max(driven) * case.facts.wheel_radius
    return 0.1 * case.facts.top_speed


@rule
def reward_too_small(case: Case) -> Iterator[Finding]:
    """A reward term that costs next to nothing at its tolerance.

    Weights are multiplied by the control step and mean nothing by themselves. What an error of its tolerance costs
    is held against what a perfect robot earns: below 1 % the term is lost in the noise of the return. Source:
    Isaac Lab 2.3.2, ``isaaclab/managers/reward_manager.py``: value · weight · dt.
    """
    found = contributions(case)
    best = earned_per_second(found)
    for item in found:
        cost = abs(item.weight) * item.cost
        if item.once or item.value is None or cost == 0.0 or best <= 0.0 or cost >= _AUDIBLE * best:
            continue
        key, weight = f"{item.term.path}.weight", _audible_weight(item, best)
        yield Finding(
            key,
            f"being off by {item.tolerance} costs {cost * case.episode_s:.2g} of {best * case.episode_s:.3g} in an "
            f"episode: {100 * cost / best:.2g} %",
            "a narrower std: no weight makes it 1 %" if weight is None else f"a weight near {weight:g} makes it 1 %",
            {"cost_per_s": cost, "best_per_s": best, "share": cost / best},
            () if weight is None else ({key: weight},),
        )


def _audible_weight(item: Contribution, best: float) -> float | None:
    """Return the least weight at which a term's error costs enough; None when a larger weight only earns more."""
    if item.weight < 0.0:
        return -at_least(_AUDIBLE * best / item.cost)
    others, gain = best - item.weight * item.best, item.cost - _AUDIBLE * item.best
    return at_least(_AUDIBLE * others / gain) if gain > 0.0 and others > 0.0 else None


@rule
def falling_pays(case: Case) -> Iterator[Finding]:
    """A failure that costs less than going on.

    Going on is worth the sum of all terms at their tolerances, over the horizon 1/(1 - gamma) of the discount or
    the episode; where that is below the price of failing, the policy learns to fall at once. Source: the
    discounted return of PPO, Schulman et al. 2017.
    """
    found = contributions(case)
    living = sum(c.weight * (c.value or 0.0) for c in found if not c.once)
    failing = sum(c.weight * (c.value or 0.0) for c in found if c.term.kind in FAILURES)
    steps = min(horizon_steps(case), case.episode_steps)
    if living * steps < failing or (living < 0.0 and failing == 0.0):
        yield Finding(
            "env.rewards",
            f"going on is worth {living * case.step_dt:.3g} a step at the tolerances, "
            f"{living * steps * case.step_dt:.3g} over {steps:.0f} steps, and failing {failing * case.step_dt:.3g} "
            "once: falling at once pays",
            "more for being alive, or a dearer failure",
            {"living_per_s": living, "failing": failing, "steps": steps},
        )


def horizon_steps(case: Case) -> float:
    """Return 1/(1 - gamma), the steps over which the agent looks ahead; inf without discount."""
    gamma = float(case.agent["algorithm"].get("gamma", 0.99))
    return 1.0 / (1.0 - gamma) if gamma < 1.0 else math.inf


_GAMMA = "agent.algorithm.gamma"
_AVERAGE = "agent.average_iterations"
_DUST = 1e-9  # of binary fractions, in 1 - gamma
_FALLS = 5.0  # time constants of the fall that the discount should reach
_EARLY = 0.25  # most of a mean of weights that may be of its beginning


@rule
def ppo_batch(case: Case) -> Iterator[Finding]:
    """A batch that does not divide into its mini-batches.

    rsl_rl cuts the batch of num_envs · num_steps_per_env samples into mini-batches of a whole size and drops the
    rest. Source: rsl_rl, ``storage/rollout_storage.py``.
    """
    batch = int(case.env["num_envs"]) * int(case.agent["num_steps_per_env"])
    parts = int(case.agent["algorithm"].get("num_mini_batches", 1))
    if batch % parts:
        yield Finding(
            "agent.algorithm.num_mini_batches",
            f"{batch} samples in {parts} mini-batches of {batch // parts} leave {batch % parts} unused",
            "a number of environments or steps that the mini-batches divide",
            {"batch": batch, "mini_batches": parts, "unused": batch % parts},
        )


@rule
def discount_horizon(case: Case) -> Iterator[Finding]:
    """A discount that looks further than an episode, or less far than a fall.

    1/(1 - gamma) steps ahead a reward counts 1/e. Beyond the episode's end the agent learns of what never comes;
    short of some five time constants of the fall it does not see what its actions lead to. Source: the discounted
    return.
    """
    steps = horizon_steps(case)
    seconds = steps * case.step_dt
    balance = case.facts.balance
    fall = _FALLS / balance.pole if balance is not None else 0.0
    if steps > case.episode_steps * (1 + _DUST):
        yield Finding(
            _GAMMA,
            f"the discount looks {seconds:.3g} s ahead, and an episode lasts {case.episode_s:g} s",
            figures={"horizon_s": seconds if math.isfinite(seconds) else -1.0, "episode_s": case.episode_s},
            **_advice(case, fall, "most", at_least(1.0 / case.episode_steps, 3)),
        )
    if balance is not None and seconds < fall * (1 - _DUST):
        yield Finding(
            _GAMMA,
            f"the discount looks {seconds:.3g} s ahead, {seconds * balance.pole:.2g} time constants of the fall",
            figures={"horizon_s": seconds, "time_constant_s": 1 / balance.pole},
            **_advice(case, fall, "least", at_most(case.step_dt / fall, 3)),
        )


def _advice(case: Case, fall: float, bound: str, share: float) -> dict[str, Any]:
    """Return hint and advice: a gamma of 1 - share, where the episode is long enough for one."""
    if case.episode_s < fall:
        return {"hint": f"episodes longer than {fall:.2g} s first: no gamma reaches a fall and ends within an episode"}
    gamma = round(1.0 - share, 12)
    return {"hint": f"gamma of at {bound} {gamma:g}", "advice": ({_GAMMA: gamma},)}


@rule
def late_average(case: Case) -> Iterator[Finding]:
    """A mean of the policy's weights that is much of what they were at the beginning of the training.

    It is the mean of all n iterations at first, and m += (w - m) / n behind these: (1 - 1/n)^(i - n) of that is left
    after i iterations, in what is played, be the beginning noise or the policy of ``init_from``. Source: the weights of
    an exponential mean.
    """
    reach, iterations = int(case.agent.get("average_iterations") or 0), int(case.agent["max_iterations"])
    if reach < 2:
        return
    early = (1.0 - 1.0 / reach) ** max(iterations - reach, 0)
    if early > _EARLY:
        few = int(iterations / (1.0 - math.log(_EARLY)))  # (1 - 1/n)^(i - n) is at most exp(1 - i/n)
        enough = few if few > 1 else 0  # the mean of one is no mean
        yield Finding(
            _AVERAGE,
            f"{100 * early:.0f} % of what is played is of iterations 1 to {min(reach, iterations)} of {iterations}",
            f"at most {enough}, or more iterations",
            {"early_share": early},
            ({_AVERAGE: enough},),
        )


@rule
def noop_curriculum(case: Case) -> Iterator[Finding]:
    """A change of a reward's weight that changes nothing, or that training never reaches.

    The weight changes once the counter of control steps has passed ``num_steps``; a training takes
    max_iterations · num_steps_per_env of them. Source: Isaac Lab 2.3.2, ``isaaclab/envs/mdp/curriculums.py``.
    """
    total = int(case.agent["max_iterations"]) * int(case.agent["num_steps_per_env"])
    for term in case.terms("curriculum", "curriculums.modify_reward_weight"):
        reward, weight, start = term.node["term_name"], float(term.node["weight"]), int(term.node["num_steps"])
        before = float(case.env["rewards"][reward]["weight"])
        if weight == before:
            yield Finding(
                f"{term.path}.weight",
                f"'{reward}' has the weight {before:g} from the start: the change to {weight:g} changes nothing",
                "another weight, here or there, or no curriculum",
                {"before": before, "after": weight},
            )
        if start >= total:
            yield Finding(
                f"{term.path}.num_steps",
                f"training takes {total} control steps, and the weight changes after {start}",
                f"num_steps below {total}, or more iterations",
                {"num_steps": start, "total_steps": total},
                ({f"{term.path}.num_steps": total - 1},),
            )


@rule
def levels_out_of_reach(case: Case) -> Iterator[Finding]:
    """Levels of ground that no robot ever climbs to.

    A robot goes a level up when it ends an episode further than half a tile from its beginning. In a longest episode
    at the largest command it comes v T far. Source: Isaac Lab 2.3.2,
    ``isaaclab_tasks/manager_based/locomotion/velocity/mdp/curriculums.py``, ``terrain_levels_vel``.
    """
    for term in case.terms("curriculum", "curriculums.terrain_levels_vel"):
        size = case.env["scene"]["terrain"].get("size")
        if size is None:
            message = "the ground has no tiles: no level ever changes"
            yield Finding(term.path, message, "scene=rough, another ground of tiles, or no such curriculum")
            continue
        command = case.env["commands"].get(term.node.get("command_name", "base_velocity"), {})
        ranges = command.get("ranges")
        if not isinstance(ranges, Mapping):
            continue
        speed = math.hypot(*(largest(ranges.get(axis)) for axis in ("lin_vel_x", "lin_vel_y")))
        far, half = speed * case.episode_s, float(size[0]) / 2
        if far > half:
            continue
        key, longer = "env.episode_length_s", above(half / speed) if speed else math.inf
        yield Finding(
            "env.scene.terrain.size",
            f"at {speed:g} m/s a robot comes {far:.3g} m far in an episode of {case.episode_s:g} s, "
            f"and goes a level up beyond {half:g} m, half a tile",
            f"episodes of {longer:g} s, smaller tiles or faster commands" if speed else "commands that are not zero",
            {"speed_m_s": speed, "way_m": far, "half_tile_m": half},
            ({key: longer},) if speed else (),
        )
