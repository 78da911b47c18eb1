"""Training with rsl_rl's PPO, or its distillation: one iteration is a rollout and an update."""

from __future__ import annotations

import copy
import io
import itertools
import math
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, redirect_stdout
from dataclasses import dataclass
from typing import Any

import torch
from rsl_rl.utils import resolve_callable

from wheelleg_exp.errors import ConfigError, RunDirectoryError, SimulationFailure, WheellegError, nearest_name
from wheelleg_exp.managers.finite import require_finite_actions
from wheelleg_exp.managers.streams import stream_seed
from wheelleg_exp.memory import require_memory
from wheelleg_exp.packages import make_classes_importable
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.rl.checkpoint import FORMAT_VERSION, load_unsaved_state, unsaved_state
from wheelleg_exp.rl.episode_log import EpisodeLog, FailureCount
from wheelleg_exp.rl.global_draws import no_global_draws
from wheelleg_exp.rl.graphed_update import GraphedUpdate, can
from wheelleg_exp.rl.matmul import bfloat16_products, chosen_matmul, tf32_products
from wheelleg_exp.rl.one_thread import one_thread
from wheelleg_exp.rl.options import require_agent
from wheelleg_exp.rl.rank_errors import communicating, is_communication, left
from wheelleg_exp.rl.ranks import ALONE, Ranks
from wheelleg_exp.rl.step_means import StepMeans
from wheelleg_exp.rl.symmetry.mirror import Mirror, options_of
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.state import cloned
from wheelleg_exp.user_code import ending_as, in_words, place

# Keys of the agent section that are this program's, not rsl_rl's.
OWN_KEYS = (
    "device",
    "torch_threads",
    "matmul",
    "graph_update",
    "max_iterations",
    "save_interval",
    "clip_actions",
    "logger",
    "max_non_finite",
    "symmetry",
    "teacher_checkpoint",
)


@dataclass(frozen=True)
class Iteration:
    """What one iteration did.

    Attributes:
        index: its number, from 0.
        scalars: what is logged, by rsl_rl's and Isaac Lab's keys.
        env_steps: environment steps of the rollout.
    """

    index: int
    scalars: dict[str, float]
    env_steps: int


@dataclass(frozen=True)
class Initial:
    """What a training begins with in place of networks that were drawn.

    Attributes:
        state: a checkpoint, or a part of one.
        parts: what is loaded of it: ``actor``, ``critic``, ``optimizer``.
        facts: whose it is, plain.
    """

    state: Mapping[str, Any]
    parts: tuple[str, ...]
    facts: Mapping[str, Any]


class Trainer:
    """Trains a policy.

    The policy's own draws (initial weights, exploration, minibatches) come from torch's global generator, which
    nothing in the environment uses.

    Args:
        env: the adapted environment.
        agent: the composed ``agent`` section, plain.
        seed: the run's seed.
        teacher: the checkpoint whose policy teaches, of a distillation.
        initial: what the networks begin with; what explores and what is simulated begin anew.
        ranks: the processes that train together; the others must have a trainer as well.

    Raises:
        ConfigError: rsl_rl refuses the section, or the teacher or the initial networks do not fit it.
    """

    def __init__(
        self,
        env: RslRlVecEnv,
        agent: Mapping[str, Any],
        seed: int,
        teacher: Mapping[str, Any] | None = None,
        initial: Initial | None = None,
        ranks: Ranks = ALONE,
    ) -> None:
        self.env = env
        self.ranks = ranks
        self.device = str(agent["device"])
        self.num_steps = int(agent["num_steps_per_env"])
        self.iteration = 0
        self._agent = dict(agent)
        torch.manual_seed(stream_seed(ranks.seed(seed), "agent"))
        self.algorithm = build_algorithm(env, agent, ranks)
        if teacher is not None:
            _load_teacher(self.algorithm, teacher)
        if initial is not None:
            _load_initial(self.algorithm, initial)
        self.log = EpisodeLog(env.num_envs, env.env.device)
        self._means = StepMeans(env.env)
        self._matmul = chosen_matmul(agent)
        graphs = bool(agent.get("graph_update")) and can(self.algorithm)
        self._graphed = GraphedUpdate(self.algorithm) if graphs else None

    def learn(self, until: int) -> Iterator[Iteration]:
        """Train up to ``until`` iterations in total; yields after each, when everything is whole.

        Where several processes train together, all of them must ask for each iteration. What the first yields is of
        all: scalars are means, steps are sums.

        Raises:
            SimulationFailure: numbers were not finite: observations, actions, what an event wrote, a loss, a parameter,
                or physics and rewards in more environments than may be (``agent.max_non_finite``).
        """
        self.algorithm.train_mode()
        if self.ranks.together:
            self.algorithm.broadcast_parameters()
        while self.iteration < until:
            start = time.perf_counter()
            with self.ranks.agreed(), self._told(), no_global_draws("numpy", "python"):
                self._collect()
            collected = time.perf_counter()
            with self._told(), self._products():
                losses = self._graphed() if self._graphed else self.algorithm.update()
            with self.ranks.agreed():
                self._require_sane(losses)
            if self.ranks.together:
                self._share_buffers()
            learned = time.perf_counter()
            scalars = self.log.collect() | self._means.collect()
            scalars |= {f"Loss/{name}": float(value) for name, value in losses.items()}
            scalars["Loss/learning_rate"] = float(self.algorithm.learning_rate)
            scalars["Policy/mean_std"] = self.algorithm.get_policy().output_std.mean().item()
            steps = self.num_steps * self.env.num_envs
            scalars["Perf/total_fps"] = steps / (learned - start)
            scalars["Perf/collection_time"] = collected - start
            scalars["Perf/learning_time"] = learned - collected
            scalars = self.ranks.merged(scalars, ("Perf/collection_time", "Perf/learning_time"))
            done = Iteration(self.iteration, scalars, steps * self.ranks.size)
            self.iteration += 1
            yield done

    @torch.inference_mode()
    def _collect(self) -> None:
        """Roll the policy out and compute returns."""
        observations = self.env.get_observations().to(self.device)
        failed = FailureCount(self.env.num_envs, self._agent)
        for _ in range(self.num_steps):
            actions = self.algorithm.act(observations).to(self.env.env.device)
            require_finite_actions(self.env.env, actions)
            with no_global_draws("torch"):
                observations, rewards, dones, extras = self.env.step(actions)
            failed.take(extras)
            failed.require_few(f"by control step {self.env.env.common_step_counter}")
            self.log.step(rewards, dones, extras)
            self._means.take()
            observations, rewards, dones = (x.to(self.device) for x in (observations, rewards, dones))
            self.algorithm.process_env_step(observations, rewards, dones, extras)
        with one_thread():
            self.algorithm.compute_returns(observations)

    def _share_buffers(self) -> None:
        """Give all processes the first's running means of observations: each has seen its own samples alone."""
        networks, rnd = self.networks(), getattr(self.algorithm, "rnd", None)
        with communicating():
            for buffer in (b for network in [*networks, *([rnd] if rnd else [])] for b in network.buffers()):
                torch.distributed.broadcast(buffer, src=0)

    def networks(self) -> list[torch.nn.Module]:
        """Return actor and critic, or student and teacher."""
        return [getattr(self.algorithm, role) for role in checkpoint.roles_of(self.algorithm)]

    def _products(self) -> AbstractContextManager[None]:
        """Return in what an update multiplies."""
        if self._matmul == "float32":
            return nullcontext()
        if self._matmul == "tf32":
            return tf32_products()
        return bfloat16_products(self.networks())

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Tell of an error in rsl_rl or in a network: numbers that have grown too large end in many ways."""
        try:
            yield
        except SimulationFailure as error:
            error.message += f", in iteration {self.iteration}"
            raise
        except (WheellegError, ImportError):
            raise
        except Exception as error:
            if self.ranks.together and is_communication(error):
                raise left() from error
            self._require_sane({}, error)
            raise SimulationFailure(
                f"learning fails in iteration {self.iteration}: {in_words(error).splitlines()[0]}",
                key="agent",
                where=place(error),
                expected="networks that work, and a learning_rate at which numbers do not grow without bound",
                evidence=self._learning({}),
            ) from error

    def _require_sane(self, losses: Mapping[str, float], cause: Exception | None = None) -> None:
        """Refuse losses and parameters that are not finite."""
        bad = [f"the {name} loss is {value}" for name, value in losses.items() if not math.isfinite(value)]
        for role in checkpoint.roles_of(self.algorithm):
            network = getattr(self.algorithm, role)
            wrong = (name for name, values in network.named_parameters() if not values.isfinite().all())
            bad += [f"the {role}'s {name} is not finite" for name in wrong]
        if bad:
            more = f", and {len(bad) - 1} more" if len(bad) > 1 else ""
            raise SimulationFailure(
                f"{bad[0]}{more}, in the update of iteration {self.iteration}",
                key="agent.algorithm",
                expected="finite numbers; a lower learning_rate or max_grad_norm may help",
                evidence=self._learning(losses),
            ) from cause

    def _learning(self, losses: Mapping[str, float]) -> dict[str, torch.Tensor]:
        """Return what there is to keep of an update that failed."""
        rate = {"learning_rate": torch.tensor(float(self.algorithm.learning_rate))}
        return rate | {f"loss.{name}": torch.tensor(float(value)) for name, value in losses.items()}

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the coming iterations depend on; ``iter`` is the last finished iteration."""
        return {
            "format_version": FORMAT_VERSION,
            "iter": self.iteration - 1,
            "infos": None,
            **cloned(self.algorithm.save()),  # else it would go on with the networks
            "unsaved": unsaved_state(self.algorithm),
            "env": self.env.env.state_dict(),
            "log": self.log.state_dict(),
            "rng": self._random_state(),
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned; the random state comes last, because building draws.

        Raises:
            RunDirectoryError: it is the state of other networks, or of another environment.
        """
        checkpoint.require_resumable(saved)
        try:
            self.algorithm.load(dict(saved), None, True)
            load_unsaved_state(self.algorithm, saved["unsaved"])
            self.env.env.load_state_dict(saved["env"])
            self.log.load_state_dict(saved["log"])
            torch.set_rng_state(saved["rng"]["torch"])
            if "device" in saved["rng"]:
                torch.get_device_module(self.device).set_rng_state(saved["rng"]["device"], self.device)
        except (RuntimeError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise RunDirectoryError(
                f"the saved state does not fit: {reason[:200]}",
                expected="the state of the same networks, terms, robot and number of environments",
            ) from error
        self.iteration = saved["iter"] + 1

    def set_learning_rate(self, value: float) -> None:
        """Set the learning rate of the coming updates; an adaptive schedule goes on from it."""
        self.algorithm.learning_rate = value
        for group in self.algorithm.optimizer.param_groups:
            group["lr"] = value

    def _random_state(self) -> dict[str, torch.Tensor]:
        state = {"torch": torch.get_rng_state()}
        if torch.device(self.device).type not in ("cpu", "meta"):
            state["device"] = torch.get_device_module(self.device).get_rng_state(self.device)
        return state


def build_algorithm(env: RslRlVecEnv, agent: Mapping[str, Any], ranks: Ranks = ALONE) -> Any:
    """Build rsl_rl's algorithm from the ``agent`` section.

    Raises:
        ConfigError: an observation group is missing, or rsl_rl refuses a value.
    """
    observations = env.get_observations()
    for role, groups in agent["obs_groups"].items():
        for group in groups:
            if group not in observations:
                raise ConfigError(
                    f"there is no observation group '{group}'",
                    key=f"agent.obs_groups.{role}",
                    expected="some of " + ", ".join(observations.keys()),
                    nearest=nearest_name(group, observations.keys()),
                )
            found = observations[group]
            if not isinstance(found, torch.Tensor) or found.ndim != 2:
                name = "flatten_history_dim" if isinstance(found, torch.Tensor) else "concatenate_terms"
                message, key = "a network takes one flat vector a group", f"env.observations.{group}.{name}"
                raise ConfigError(message, key=key, expected=f"{name}: true")
    if env.num_actions == 0:
        raise ConfigError("there are no actions to learn", key="env.actions", expected="at least one action term")
    _require_device(str(agent["device"]))
    require_agent(agent, env.num_envs)
    if torch.device(agent["device"]).type == "cpu":
        _require_memory(env, observations, agent)
    options = options_of(agent)
    if options is not None:
        groups = [group for role in ("actor", "critic") for group in agent["obs_groups"].get(role, [])]
        env.mirror = Mirror(env.env, options, groups, str(agent["device"]))
    # rsl_rl changes the dictionary that it is given, and prints the networks.
    config = copy.deepcopy({key: value for key, value in agent.items() if key not in OWN_KEYS})
    config["multi_gpu"] = ranks.for_rsl_rl()
    make_classes_importable(config)
    try:
        with redirect_stdout(io.StringIO()), ending_as(ConfigError):
            kind = resolve_callable(config["algorithm"]["class_name"])
            return kind.construct_algorithm(observations, env, config, str(agent["device"]))
    except Exception as error:  # its classes may be a user's own
        raise ConfigError(
            f"rsl_rl refuses it: {in_words(error).splitlines()[0]}",
            key="agent",
            expected="rsl_rl's own configuration",
        ) from error


def _load_teacher(algorithm: Any, state: Mapping[str, Any]) -> None:
    """Give the teacher what a checkpoint's policy has learned."""
    try:
        algorithm.load({"actor_state_dict": checkpoint.policy_state(state)}, {"teacher": True}, True)
    except RuntimeError as error:
        raise ConfigError(
            "the teacher's network is not the one of this checkpoint",
            key="agent.teacher_checkpoint",
            expected="agent.teacher and agent.obs_groups.teacher as the actor and its groups that were trained",
        ) from error


def _load_initial(algorithm: Any, initial: Initial) -> None:
    """Give the networks what a checkpoint's have learned; nothing is drawn, so that all else begins as without."""
    whose = initial.facts.get("named") or initial.facts.get("checkpoint")
    wrong = []
    for role in (part for part in initial.parts if part in checkpoint.ROLES):
        has = {name: list(value.shape) for name, value in initial.state[f"{role}_state_dict"].items()}
        needs = {name: list(value.shape) for name, value in getattr(algorithm, role).state_dict().items()}
        name = next((name for name in dict.fromkeys([*needs, *has]) if needs.get(name) != has.get(name)), None)
        if name is not None:
            wrong.append(f"the {role}'s {name} is {has.get(name, 'absent')} there and {needs.get(name, 'absent')} here")
    if wrong:
        raise ConfigError(
            f"the networks of '{whose}' do not fit: {'; '.join(wrong)}",
            key="init_from",
            expected="the observations, actions and networks that it was trained with, or null",
        )
    try:
        algorithm.load(dict(initial.state), dict.fromkeys(initial.parts, True), True)
    except (RuntimeError, LookupError, ValueError, TypeError) as error:
        raise ConfigError(
            f"the {', '.join(initial.parts)} of '{whose}' cannot be loaded: {' '.join(str(error).split())[:200]}",
            key="init_from_what",
            expected="networks, or the algorithm and the optimiser that it was trained with",
        ) from error


def _require_memory(env: RslRlVecEnv, observations: Any, agent: Mapping[str, Any]) -> None:
    """Refuse rollouts and networks that do not fit into memory: numbers of four bytes."""
    steps, widths = int(agent["num_steps_per_env"]), {g: v.shape[1] for g, v in observations.items()}
    samples = env.num_envs * steps
    numbers = sum(widths.values()) + 3 * env.num_actions + 6
    what = f"rollouts of {env.num_envs} environments times {steps} steps"
    require_memory(4 * samples * numbers, "agent.num_steps_per_env", what)
    for role in (role for role in checkpoint.ROLES if role in agent):
        hidden = agent[role].get("hidden_dims") or []
        layers = [sum(widths.get(g, 0) for g in agent["obs_groups"].get(role, [])), *hidden, env.num_actions]
        weights = sum(a * b for a, b in itertools.pairwise(layers))
        # Beside each weight its gradient, and the two means of Adam.
        require_memory(16 * weights, f"agent.{role}.hidden_dims", f"{weights:,} weights and what trains them")


def _require_device(name: str) -> None:
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        known = re.match(r"Expected one of (.+) device type", reason)
        raise ConfigError(
            f"torch cannot use '{name}'" + ("" if known else f": {reason}"),
            key="agent.device",
            expected="cpu, or a device that this torch and this machine have",
            nearest=nearest_name(name, known.group(1).split(", ")) if known else None,
        ) from error
