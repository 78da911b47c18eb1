"""rsl_rl's PPO as CUDA graphs: acting, and the update of the networks.

In every minibatch, rsl_rl waits for the GPU four times, and launches about three hundred kernels. Here, each minibatch
is one CUDA graph, and an update waits once. The learning rate and the sums of losses stay on the GPU, because a graph
cannot read Python numbers that change. Networks, losses, gradient clipping, and Adam are rsl_rl's own. The graph
includes the communication of the ranks. rsl_rl itself updates algorithms that ``can_capture_update`` rejects.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from rsl_rl.algorithms import PPO, Distillation
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict
from torch import nn

from wheelleg_exp.rl.network_loading import InitialPolicy
from wheelleg_exp.rl.symmetry import is_mirror_loss_only, mirror_loss

_LOSSES = ("value", "surrogate", "entropy")
_MIRROR_LOSS = "symmetry"  # rsl_rl's name
# rsl_rl's adaptive learning rate has a lower and an upper bound, and changes by a constant factor.
_SLOWEST, _FASTEST, _FACTOR = 1e-5, 1e-2, 1.5


def can_capture_update(algorithm: PPO | Distillation) -> bool:
    """Return whether an update can be captured: plain PPO on a GPU, with or without the mirror loss."""
    return torch.device(algorithm.device).type == "cuda" and is_plain_ppo(algorithm)


def is_plain_ppo(algorithm: PPO | Distillation) -> bool:
    """Return whether an algorithm is rsl_rl's PPO with Adam, MLPs, and no extension except a mirror loss."""
    if type(algorithm) is not PPO or type(algorithm.optimizer) is not torch.optim.Adam:
        return False
    symmetry = algorithm.symmetry
    extras = algorithm.rnd or algorithm.use_mixed_precision or not (symmetry is None or is_mirror_loss_only(symmetry))
    networks = (algorithm.actor, algorithm.critic)
    others = any(network.is_recurrent or type(network).forward is not MLPModel.forward for network in networks)
    compiled = algorithm.actor is not algorithm._raw_actor or algorithm.critic is not algorithm._raw_critic
    return not (extras or others or compiled)


class CapturedPPO:
    """Runs the acting and the update of rsl_rl's PPO, as CUDA graphs if ``captures``, with the loss of ``initial``."""

    def __init__(self, algorithm: PPO, initial: InitialPolicy | None = None, *, captures: bool = True) -> None:
        self.update = CapturedUpdate(algorithm, initial, captures=captures)
        # A CUDA graph draws actions only from a normal distribution; rsl_rl draws actions from other distributions.
        is_normal = getattr(type(algorithm.actor.distribution), "sample", None) is GaussianDistribution.sample
        self.act = CapturedActing(algorithm) if captures and is_normal else algorithm.act


class CapturedUpdate:
    """Updates the networks of rsl_rl's PPO with the same results as ``PPO.update``.

    The first update runs without a graph, and the second is captured; likewise after a change of the networks that
    learn (``agent.warm_critic``). The loss of the ``initial`` policy, if any, is added. After each update, the
    optimizer's settings are restored, so that rsl_rl can save and load it. A graph reads fixed addresses: if the
    address of a tensor changes, for example when a checkpoint is loaded, a new graph is captured.
    """

    def __init__(self, algorithm: PPO, initial: InitialPolicy | None = None, *, captures: bool = True) -> None:
        self._algorithm, self._initial = algorithm, initial
        self._on_gpu = torch.device(algorithm.device).type == "cuda"
        self._stream = torch.cuda.Stream(algorithm.device) if captures and self._on_gpu else None
        self._graph: Any = None
        self._captured: tuple[int, ...] = ()
        self._learned: list[bool] = []  # which of the actor's parameters learned in the last update
        storage = algorithm.storage
        rows = storage.num_envs * storage.num_transitions_per_env // algorithm.num_mini_batches
        self._rows = torch.zeros(rows, dtype=torch.long, device=algorithm.device)
        self._advantages = torch.zeros_like(storage.returns)
        self._rate = torch.zeros((), device=algorithm.device)
        symmetry = algorithm.symmetry
        # If ``use_mirror_loss`` is False, the mirror loss is only logged, and its weight is 0.
        self._mirror_weight = symmetry.mirror_loss_coeff if symmetry and symmetry.use_mirror_loss else 0.0
        self._losses = (*_LOSSES, *([_MIRROR_LOSS] if symmetry else []), *(["initial_kl"] if initial else []))
        self._sums = torch.zeros(len(self._losses), device=algorithm.device)

    def __call__(self) -> dict[str, float]:
        """Update the policy and value networks, and return the mean losses by name."""
        algorithm, storage = self._algorithm, self._algorithm.storage
        count, learns = algorithm.num_mini_batches, [p.requires_grad for p in algorithm.actor.parameters()]
        order = torch.randperm(count * len(self._rows), device=algorithm.device).view(count, -1)
        self._advantages.copy_(storage.advantages)
        self._rate.fill_(algorithm.learning_rate)
        self._sums.zero_()
        # Switch Adam to one fused kernel with the learning rate on the GPU, and store Adam's previous settings.
        optimizer = self._algorithm.optimizer
        settings = [{key: group[key] for key in ("capturable", "fused", "foreach")} for group in optimizer.param_groups]
        for group in optimizer.param_groups:
            group["lr"] = self._rate
            if self._on_gpu:
                group.update(capturable=True, fused=True, foreach=False)
        if self._on_gpu:
            for parameter, state in optimizer.state.items():
                if isinstance(state.get("step"), torch.Tensor):
                    state["step"] = state["step"].to(parameter.device)
        if self._stream is None:
            self._each(order, self._minibatch)
        elif self._learned == learns:
            if self._graph is None or self._captured != self._memory():
                self._capture(order)
            self._each(order, self._graph.replay)
        else:
            # Compute first gradients in the CUDA stream of the later capture, because torch keeps using that stream.
            self._stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(self._stream):
                self._each(order, self._minibatch)
            torch.cuda.current_stream().wait_stream(self._stream)
            self._learned, self._graph = learns, None
        observations = storage.observations.flatten(0, 1)
        for network in (algorithm.actor, algorithm.critic):
            # Update means and standard deviations of observations in place, because the CUDA graph reads them there.
            before = dict(network.named_buffers())
            network.update_normalization(observations)
            for name, static in before.items():
                now = network.get_buffer(name)
                if now is not static:
                    static.copy_(now)
                    holder, _, last = name.rpartition(".")
                    setattr(network.get_submodule(holder), last, static)
        rate, *sums = torch.cat([self._rate.view(1), self._sums]).tolist()
        self._algorithm.learning_rate = rate
        for group, own in zip(self._algorithm.optimizer.param_groups, settings, strict=True):
            group.update(own, lr=rate)
        storage.clear()
        updates = algorithm.num_learning_epochs * count
        return {name: total / updates for name, total in zip(self._losses, sums, strict=True)}

    def _each(self, order: torch.Tensor, work: Callable[[], None]) -> None:
        for _ in range(self._algorithm.num_learning_epochs):
            for rows in order:
                self._rows.copy_(rows)
                work()

    def _capture(self, order: torch.Tensor) -> None:
        self._rows.copy_(order[0])
        torch.cuda.synchronize()
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, stream=self._stream, capture_error_mode="thread_local"):
            self._minibatch()
        self._captured = self._memory()

    def _memory(self) -> tuple[int, ...]:
        """Return the tensors' memory addresses, which can change when a checkpoint is loaded."""
        algorithm, storage = self._algorithm, self._algorithm.storage
        states = [v for state in algorithm.optimizer.state.values() for v in state.values()]
        extras = [*states, storage.returns, storage.values, *(storage.distribution_params or ())]
        return (*_addresses(algorithm), *(v.data_ptr() for v in extras if isinstance(v, torch.Tensor)))

    def _minibatch(self) -> None:
        algorithm, storage, rows = self._algorithm, self._algorithm.storage, self._rows
        observations = storage.observations.flatten(0, 1)[rows]
        taken = (storage.actions, storage.values, storage.returns, storage.actions_log_prob, self._advantages)
        actions, old_values, returns, old_log_prob, advantages = (v.flatten(0, 1)[rows] for v in taken)
        old_params = tuple(values.flatten(0, 1)[rows] for values in storage.distribution_params or ())
        if algorithm.normalize_advantage_per_mini_batch:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        actor = algorithm.actor
        # Do not call the actor's `forward`, because `forward` makes the CPU wait for the GPU.
        actor.distribution.update(actor.mlp(actor.get_latent(observations)))
        log_prob = actor.get_output_log_prob(actions)
        values = algorithm.critic(observations)
        entropy = actor.output_entropy.mean()
        if algorithm.desired_kl is not None and algorithm.schedule == "adaptive":
            with torch.no_grad():
                divergence = actor.get_kl_divergence(old_params, actor.output_distribution_params).mean()
                if algorithm.is_multi_gpu:
                    torch.distributed.all_reduce(divergence)
                    divergence /= algorithm.gpu_world_size
                # Lower the learning rate if the KL divergence is too large, and raise the rate if it is too small.
                desired, rate = self._algorithm.desired_kl, self._rate
                slower, faster = (rate / _FACTOR).clamp(min=_SLOWEST), (rate * _FACTOR).clamp(max=_FASTEST)
                raised = torch.where((divergence < desired / 2) & (divergence > 0), faster, rate)
                rate.copy_(torch.where(divergence > desired * 2, slower, raised))
        # The policy loss is the negative clipped surrogate objective of PPO (Schulman et al. 2017, eq. 7).
        change = log_prob - old_log_prob.squeeze(-1)
        advantages = advantages.squeeze(-1)
        ratio, clip = change.exp(), self._algorithm.clip_param
        clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
        surrogate = torch.max(-advantages * ratio, -advantages * clipped).mean()
        value = self._value(values, old_values, returns)
        loss = surrogate + algorithm.value_loss_coef * value - algorithm.entropy_coef * entropy
        found: list[torch.Tensor] = []
        if algorithm.symmetry:
            found = [mirror_loss(algorithm.symmetry, actor, observations)]
            loss = loss + self._mirror_weight * found[0]
        if self._initial is not None:
            found.append(self._initial.loss(actor, observations))
            loss = loss + self._initial.weight * found[-1]
        algorithm.optimizer.zero_grad()
        loss.backward()
        if algorithm.is_multi_gpu:
            algorithm.reduce_parameters()
        for network in (algorithm.actor, algorithm.critic):
            nn.utils.clip_grad_norm_(network.parameters(), algorithm.max_grad_norm)
        algorithm.optimizer.step()
        self._sums += torch.stack([one.detach() for one in (value, surrogate, entropy, *found)])

    def _value(self, values: torch.Tensor, old: torch.Tensor, returns: torch.Tensor) -> torch.Tensor:
        """Return PPO's clipped value loss: the larger squared error of the critic's value and the clipped value."""
        error = (values - returns).pow(2)
        if not self._algorithm.use_clipped_value_loss:
            return error.mean()
        clip = self._algorithm.clip_param
        clipped = old + (values - old).clamp(-clip, clip)
        return torch.max(error, (clipped - returns).pow(2)).mean()


class CapturedActing:
    """Draws actions and stores the data for the policy update, as rsl_rl's ``PPO.act`` does.

    The first rollout uses ``PPO.act``. The second is captured, and another one after the address of a weight has
    changed.
    """

    def __init__(self, algorithm: PPO) -> None:
        self._algorithm = algorithm
        self._graph: Any = None
        self._captured: tuple[int, ...] = ()
        self._observations: Any = None
        self._found: dict[str, object] = {}
        self._acted = False

    def __call__(self, observations: TensorDict) -> torch.Tensor:
        """Return actions (N, A) for ``observations``, a mapping from observation groups to tensors."""
        algorithm = self._algorithm
        if algorithm.storage.step == 0:
            if self._acted and self._captured != _addresses(algorithm):
                self._capture(observations)
            self._acted = True
        if self._graph is None:
            acted: torch.Tensor = algorithm.act(observations)
            return acted
        for group, values in self._observations.items():
            values.copy_(observations[group])
        self._graph.replay()
        transition = algorithm.transition
        transition.hidden_states, transition.observations = (None, None), observations
        for name, value in self._found.items():
            setattr(transition, name, value)
        actions: torch.Tensor = transition.actions.clone()  # The next replay of the CUDA graph overwrites ``_found``.
        transition.actions = actions
        return actions

    def _capture(self, observations: TensorDict) -> None:
        self._observations = observations.clone()
        torch.cuda.synchronize()
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
            self._found = self._computed()
        self._captured = _addresses(self._algorithm)

    def _computed(self) -> dict[str, object]:
        """Return the data that ``PPO.act`` stores, without torch's own sampling, which waits for the GPU."""
        actor, observations = self._algorithm.actor, self._observations
        actor.distribution.update(actor.mlp(actor.get_latent(observations)))
        mean, deviation = actor.output_mean, actor.output_std
        actions = mean + deviation * torch.randn_like(mean)
        found = {"actions": actions, "values": self._algorithm.critic(observations)}
        found["actions_log_prob"] = actor.get_output_log_prob(actions)
        return {**found, "distribution_params": tuple(actor.output_distribution_params)}


def _addresses(algorithm: PPO) -> tuple[int, ...]:
    networks = (algorithm.actor, algorithm.critic)
    return tuple(v.data_ptr() for network in networks for v in (*network.parameters(), *network.buffers()))
