"""Training with rsl_rl's PPO or distillation: one iteration is a rollout and an update."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any

import torch
from rsl_rl.models import MLPModel

from wheelleg_exp.env.undeclared import UndeclaredChanges
from wheelleg_exp.errors import ConfigError, RunDirectoryError, SimulationFailure, WheellegError
from wheelleg_exp.managers.non_finite import require_finite_actions
from wheelleg_exp.managers.streams import stream_seed
from wheelleg_exp.rl import checkpoint, policy_average
from wheelleg_exp.rl.algorithm import build_algorithm, mirrored_half
from wheelleg_exp.rl.checkpoint import FORMAT_VERSION, load_unsaved_state, unsaved_state
from wheelleg_exp.rl.determinism import no_global_draws, one_thread
from wheelleg_exp.rl.matmul import bfloat16_products, chosen_matmul, tf32_products
from wheelleg_exp.rl.network_loading import Initial, InitialPolicy, load_initial, load_teacher
from wheelleg_exp.rl.options import Agent, Learning
from wheelleg_exp.rl.policy_average import PolicyAverage
from wheelleg_exp.rl.ppo_graphs import CapturedPPO, can_capture_update, is_plain_ppo
from wheelleg_exp.rl.ranks import ALONE, Ranks, communicating, is_communication, left
from wheelleg_exp.rl.rollout_log import EpisodeLog, FailureCount, StepMeans
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.state import cloned
from wheelleg_exp.user_exceptions import in_words, place

_WARM_RATE = 1e-3  # learning rate before the policy learns with PPO


@dataclass(frozen=True)
class Iteration:
    """The result of one iteration: its number from 0, the logged scalars, and the environment steps of its rollout."""

    index: int
    scalars: dict[str, float]
    env_steps: int


class Trainer:
    """Trains a policy with the options of the agent.

    Initial weights, exploration, and minibatches are drawn from torch's global generator, which the environment does
    not use. ``teacher`` is the checkpoint of a distillation's teacher. ``initial`` replaces random networks. Before the
    first iteration, the policy imitates the ``controller``, which returns raw actions (N, A) for the present state.
    Each process (rank) has its own ``Trainer``.
    """

    def __init__(
        self,
        env: RslRlVecEnv,
        agent: Learning,
        seed: int,
        teacher: Mapping[str, object] | None = None,
        initial: Initial | None = None,
        ranks: Ranks = ALONE,
        controller: Callable[[], torch.Tensor] | None = None,
    ) -> None:
        self.env = env
        self.ranks = ranks
        self.device = agent.device
        self.num_steps = agent.num_steps_per_env
        self.iteration = 0
        self._agent = agent
        self._controller = controller
        warm = (agent.warm_start, agent.warm_critic) if isinstance(agent, Agent) else (0, 0)
        self._warm_start, self._warm_critic = warm
        torch.manual_seed(stream_seed(ranks.seed(seed), "agent"))
        self.algorithm = build_algorithm(env, agent, ranks)
        env.half = mirrored_half(env, agent)
        if controller is not None and self.algorithm.actor.is_recurrent:
            raise ConfigError("a recurrent policy cannot imitate", key="agent.warm_start", expected="0")
        if teacher is not None:
            load_teacher(self.algorithm, teacher)
        if initial is not None:
            load_initial(self.algorithm, initial, env, agent.obs_groups)
        self.notes: list[str] = []  # what the training does differently from its config, in words
        self._is_declared = False  # whether the first rollout has been checked for undeclared state
        self.log = EpisodeLog(env.num_envs, env.env.device)
        self._means = StepMeans(env.env)
        self.average = PolicyAverage(self.algorithm.get_policy(), agent.average_iterations)
        self._matmul = chosen_matmul(agent)
        # CUDA graphs give the same actions and policy updates as rsl_rl's PPO.
        captures = agent.graph_update and can_capture_update(self.algorithm)
        self._ppo: Any = self.algorithm
        if (policy := self._initial_policy(agent, initial)) or captures:
            self._ppo = CapturedPPO(self.algorithm, policy, captures=captures)

    def _initial_policy(self, agent: Learning, initial: Initial | None) -> InitialPolicy | None:
        if not isinstance(agent, Agent) or agent.initial_kl is None:
            return None
        if initial is None or not is_plain_ppo(self.algorithm):
            lacks = "has no initial policy" if initial is None else "uses an algorithm without this loss"
            expected = "null, or init_from=RUN with rsl_rl's PPO, Adam, and MLPs (docs/learning.md)"
            raise ConfigError(f"the training {lacks}", key="agent.initial_kl", expected=expected)
        return InitialPolicy(self.algorithm, agent.initial_kl, self.env)

    def learn(self, until: int) -> Iterator[Iteration]:
        """Train until the number of training iterations is ``until``, and yield the result of each iteration.

        All ranks must consume the results. The first rank yields those of all ranks: scalars are means, steps are sums.
        NaN or inf raises SimulationFailure: in an observation, an action, a number that an event wrote, a loss, a
        parameter, or in physics and rewards of more environments than ``agent.max_non_finite`` allows.
        """
        self.algorithm.train_mode()
        if self.iteration == 0 and self._controller is not None:
            with self._named_errors():
                self._imitate(self._controller)
            self._controller = None
        if self.ranks.together:
            self.algorithm.broadcast_parameters()
        while self.iteration < until:
            start = time.perf_counter()
            self._collect()
            collected = time.perf_counter()
            losses = self._update()
            learned = time.perf_counter()
            scalars = self._scalars(losses, collected - start, learned - collected)
            done = Iteration(self.iteration, scalars, self.num_steps * self.env.num_envs * self.ranks.size)
            self.iteration += 1
            yield done

    def _imitate(self, controller: Callable[[], torch.Tensor]) -> None:
        """Teach the policy the controller's actions; afterwards, the environment continues as if nothing had happened.

        In the first third of the rollouts, the controller acts, with the policy's exploration noise. Then the policy
        acts, so that it learns what to do in the states that it reaches itself (Ross, Gordon, Bagnell: DAgger, 2011).
        """
        actor, ppo, env = self.algorithm.actor, self.algorithm, self.env.env
        before, observers, env.observers = env.state_dict(), env.observers, []
        optimizer = torch.optim.Adam(actor.parameters(), _WARM_RATE)
        observations, seen, wanted = self.env.get_observations().to(self.device), [], []
        for rollout in range(self._warm_start):
            for _ in range(self.num_steps):
                target = self.env.policy_actions(controller()).to(self.device)
                seen.append(observations.select(*actor.obs_groups))
                wanted.append(target)
                with torch.no_grad():
                    actor.update_normalization(observations)
                    actions = actor(observations, stochastic_output=True)
                    if 3 * rollout < self._warm_start:
                        actions = target + actions - actor.output_mean
                    observations = self.env.step(actions.to(env.device))[0].to(self.device)
            samples, targets = torch.cat(seen), torch.cat(wanted)
            size = self.num_steps * self.env.num_envs // ppo.num_mini_batches
            for _ in range(2 * ppo.num_learning_epochs * ppo.num_mini_batches):
                rows = torch.randint(len(targets), (size,), device=self.device)
                loss = torch.nn.functional.mse_loss(actor(samples[rows]), targets[rows])
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
        env.load_state_dict(before)
        env.observers = observers

    def _collect(self) -> None:
        with self.ranks.agreed(), self._named_errors(), no_global_draws("numpy", "python"):
            self._roll_out()

    @torch.inference_mode()
    def _roll_out(self) -> None:
        observations = self.env.get_observations().to(self.device)
        failed = FailureCount(self.env.num_envs, self._agent.max_non_finite)
        undeclared = None if self._is_declared else UndeclaredChanges(self.env.env)
        for _ in range(self.num_steps):
            actions = self._ppo.act(observations).to(self.env.env.device)
            require_finite_actions(self.env.env, actions)
            with no_global_draws("torch"):
                observations, rewards, dones, extras = self.env.step(actions)
            failed.take(extras)
            failed.require_few(f"by control step {self.env.env.common_step_counter}")
            self.log.step(rewards, dones, extras)
            self._means.take()
            observations, rewards, dones = (x.to(self.device) for x in (observations, rewards, dones))
            self.algorithm.process_env_step(observations, rewards, dones, extras)
        if undeclared is not None:
            undeclared.require_none()
            self._is_declared = True
        with one_thread():
            self.algorithm.compute_returns(observations)

    def _update(self) -> dict[str, float]:
        is_warm = self.iteration < self._warm_critic
        with self._named_errors(), self._products(), self._frozen_policy() if is_warm else nullcontext():
            losses: dict[str, float] = self._ppo.update()
        with self.ranks.agreed():
            self._require_finite(losses)
        if self.ranks.together:
            # Copy the running means of observations from rank 0 to all ranks, because each rank has different samples.
            networks, rnd = self.networks(), getattr(self.algorithm, "rnd", None)
            with communicating():
                for buffer in (b for network in [*networks, *([rnd] if rnd else [])] for b in network.buffers()):
                    torch.distributed.broadcast(buffer, src=0)
        if not is_warm:
            self.average.take()
        return losses

    @contextmanager
    def _frozen_policy(self) -> Iterator[None]:
        """Freeze the policy, its noise, and its normaliser in an update; afterwards, restore the learning rate."""
        ppo = self.algorithm
        parameters = [parameter for parameter in ppo.actor.parameters() if parameter.requires_grad]
        rate, schedule = ppo.learning_rate, ppo.schedule
        ppo.schedule = "fixed"
        self.set_learning_rate(_WARM_RATE)
        ppo.actor.requires_grad_(False).eval()  # The normaliser learns only in training mode.
        try:
            yield
        finally:
            for parameter in parameters:
                parameter.requires_grad_(True)
            ppo.actor.train()
            self.set_learning_rate(rate)
            ppo.schedule = schedule

    def _scalars(self, losses: Mapping[str, float], collection_time: float, learning_time: float) -> dict[str, float]:
        scalars = self.log.collect() | self._means.collect()
        scalars |= {f"Loss/{name}": float(value) for name, value in losses.items()}
        scalars["Loss/learning_rate"] = float(self.algorithm.learning_rate)
        scalars["Policy/mean_std"] = self.algorithm.get_policy().output_std.mean().item()
        scalars["Perf/total_fps"] = self.num_steps * self.env.num_envs / (collection_time + learning_time)
        times = {"Perf/collection_time": collection_time, "Perf/learning_time": learning_time}
        return self.ranks.merged(scalars | times, tuple(times))

    def networks(self) -> list[torch.nn.Module]:
        """Return the networks of the algorithm: actor and critic, or student and teacher."""
        return [getattr(self.algorithm, role) for role in checkpoint.roles_of(self.algorithm)]

    def _products(self) -> AbstractContextManager[None]:
        if self._matmul == "tf32":
            return tf32_products()
        return bfloat16_products(self.networks()) if self._matmul == "bfloat16" else nullcontext()

    @contextmanager
    def _named_errors(self) -> Iterator[None]:
        """Convert an exception from rsl_rl or a network to a SimulationFailure that names the training iteration."""
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
            self._require_finite({}, error)
            message = f"learning fails in iteration {self.iteration}: {in_words(error).splitlines()[0]}"
            where = place(error)
            expected = "networks that work, and a learning_rate at which numbers do not grow without bound"
            evidence = self._learning({})
            raise SimulationFailure(message, key="agent", where=where, expected=expected, evidence=evidence) from error

    def _require_finite(self, losses: Mapping[str, float], cause: Exception | None = None) -> None:
        bad = [f"the {name} loss is {value}" for name, value in losses.items() if not math.isfinite(value)]
        for role in checkpoint.roles_of(self.algorithm):
            network = getattr(self.algorithm, role)
            wrong = (name for name, values in network.named_parameters() if not values.isfinite().all())
            bad += [f"the {role}'s {name} is not finite" for name in wrong]
        if bad:
            more = f", and {len(bad) - 1} more" if len(bad) > 1 else ""
            expected = "finite numbers; a lower learning_rate or max_grad_norm may help"
            message, evidence = f"{bad[0]}{more}, in the update of iteration {self.iteration}", self._learning(losses)
            raise SimulationFailure(message, key="agent.algorithm", expected=expected, evidence=evidence) from cause

    def _learning(self, losses: Mapping[str, float]) -> dict[str, torch.Tensor]:
        rate = {"learning_rate": torch.tensor(float(self.algorithm.learning_rate))}
        return rate | {f"loss.{name}": torch.tensor(float(value)) for name, value in losses.items()}

    def state_dict(self) -> dict[str, object]:
        """Return everything that a checkpoint needs to resume the training; ``iter`` is the last finished iteration."""
        rng = {"torch": torch.get_rng_state()}
        if torch.device(self.device).type not in ("cpu", "meta"):
            rng["device"] = torch.get_device_module(self.device).get_rng_state(self.device)
        return {
            **{"format_version": FORMAT_VERSION, "iter": self.iteration - 1, "infos": None},
            **cloned(self.algorithm.save()),
            **self.average.state_dict(),
            "unsaved": unsaved_state(self.algorithm) | self.average.unsaved(),
            "env": self.env.env.state_dict(),
            "log": self.log.state_dict(),
            "rng": rng,
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore a state from ``state_dict``. Raise RunDirectoryError if the saved state does not fit the training."""
        checkpoint.require_resumable(saved)
        try:
            self.algorithm.load(dict(saved), None, True)
            load_unsaved_state(self.algorithm, saved["unsaved"])
            self.average.load_state_dict(saved)
            self.env.env.load_state_dict(checkpoint.env_state(saved))
            self.log.load_state_dict(saved["log"])
            # Restore the state of random generators last, because loading the networks can draw random numbers.
            torch.set_rng_state(saved["rng"]["torch"])
            if "device" in saved["rng"]:
                torch.get_device_module(self.device).set_rng_state(saved["rng"]["device"], self.device)
        except (RuntimeError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            expected = "the state of the same networks, terms, robot and number of environments"
            raise RunDirectoryError(f"a checkpoint does not fit the run: {reason[:200]}", expected=expected) from error
        self.iteration = saved["iter"] + 1

    @contextmanager
    def played(self) -> Iterator[MLPModel]:
        """Provide the policy on the CPU as it is played: with averaged weights, if there is an average."""
        policy = self.algorithm.get_policy().to("cpu")
        own = cloned(policy.state_dict())
        policy.load_state_dict(self.average.state_dict().get(policy_average.STATE, own))
        try:
            yield policy
        finally:
            policy.load_state_dict(own)

    def set_learning_rate(self, value: float) -> None:
        """Set the learning rate of the next policy update; an adaptive schedule may change it later."""
        self.algorithm.learning_rate = value
        for group in self.algorithm.optimizer.param_groups:
            group["lr"] = value
