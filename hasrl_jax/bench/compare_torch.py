"""The PPO that `bench compare` runs on gymnasium's AsyncVectorEnv: torch, the same sizes and the same update.

A plain recurrent PPO as one would write it with `torch.nn.LSTM`: everything is batched over environments or
sequences, advantages are computed once per iteration, and no Python loop is longer than one sequence except the
environment loop itself.
"""

from typing import NamedTuple

import gymnasium
import numpy as np
import torch
from torch import nn

from hasrl_jax.config.schema import PPOConfig

Carry = tuple[torch.Tensor, torch.Tensor]  # (h, c), each [L, B, H]


class Policy(nn.Module):
    """Two LSTM layers, a tanh mean and a state-independent log standard deviation."""

    def __init__(self, observation_size: int, action_size: int, hidden_size: int, initial_log_std: float):
        super().__init__()
        self.lstm = nn.LSTM(observation_size, hidden_size, num_layers=2)
        self.mean = nn.Linear(hidden_size, action_size)
        self.log_std = nn.Parameter(torch.full((action_size,), initial_log_std))

    def step(self, observation: torch.Tensor, carry: Carry, is_first: torch.Tensor) -> tuple[torch.Tensor, Carry]:
        """One step of every environment: mean action [n, A] from observations [n, O], and the carry after it."""
        output, carry = self.lstm(observation[None], _keep(carry, ~is_first))
        return torch.tanh(self.mean(output[0])), carry

    def sequences(self, observation: torch.Tensor, carry: Carry, is_first: torch.Tensor) -> torch.Tensor:
        """Mean actions [B, T, A] of observations [B, T, O], with the carry zeroed where `is_first` [B, T]."""
        rows, steps = is_first.shape
        starts = is_first.clone()
        starts[:, 0] = True
        start = starts.flatten().nonzero().squeeze(1)
        # `nn.LSTM` cannot reset in the middle of a sequence. Cutting at the resets and padding needs one call but
        # grows with their number; beyond about two pieces per row, stepping is the faster of the two.
        if len(start) > 2 * rows:
            outputs = []
            for t in range(steps):
                output, carry = self.lstm(observation[None, :, t], _keep(carry, ~is_first[:, t]))
                outputs.append(output[0])
            return torch.tanh(self.mean(torch.stack(outputs, dim=1)))
        lengths = torch.diff(start, append=torch.tensor([rows * steps]))
        pieces = torch.split(observation.flatten(0, 1), lengths.tolist())
        hidden, cell = (state[:, start // steps] for state in carry)
        padded = nn.utils.rnn.pad_sequence(pieces)  # [longest, pieces, O]
        output, _ = self.lstm(padded, _keep((hidden, cell), ~is_first.flatten()[start]))
        inside = torch.arange(len(padded)) < lengths[:, None]
        return torch.tanh(self.mean(output.transpose(0, 1)[inside])).view(rows, steps, -1)


class Batch(NamedTuple):
    """One iteration as B sequences of T steps."""

    observation: torch.Tensor  # [B, T, O]
    action: torch.Tensor  # [B, T, A]
    log_prob: torch.Tensor  # [B, T]
    is_first: torch.Tensor  # [B, T] bool
    hidden: torch.Tensor  # [B, L, H]
    cell: torch.Tensor  # [B, L, H]
    advantage: torch.Tensor  # [B, T]
    target: torch.Tensor  # [B, T]


class Learner:
    """The two networks and their optimisers."""

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        ppo: PPOConfig,
        hidden_size: int,
        initial_log_std: float,
        seed: int,
    ):
        torch.manual_seed(seed)
        self.ppo = ppo
        self.policy = Policy(observation_size, action_size, hidden_size, initial_log_std)
        hidden = nn.Linear(observation_size, hidden_size), nn.Tanh(), nn.Linear(hidden_size, hidden_size), nn.Tanh()
        self.value = nn.Sequential(*hidden, nn.Linear(hidden_size, 1), nn.Flatten(-2))
        settings = {"eps": ppo.adam_epsilon}
        self.policy_optimizer = torch.optim.Adam(self.policy.parameters(), ppo.policy_learning_rate, **settings)
        self.value_optimizer = torch.optim.Adam(self.value.parameters(), ppo.value_learning_rate, **settings)

    @property
    def parameters(self) -> int:
        """How many numbers are learnt."""
        return sum(parameter.numel() for network in (self.policy, self.value) for parameter in network.parameters())

    def update(self, batch: Batch) -> None:
        """All epochs and minibatches of one iteration."""
        for _ in range(self.ppo.epochs):
            for rows in torch.randperm(len(batch.target)).split(self.ppo.minibatch_trajectories):
                part = Batch(*(field[rows] for field in batch))
                _descend(self.policy, self.policy_optimizer, self._policy_loss(part), self.ppo)
                _descend(self.value, self.value_optimizer, self._value_loss(part), self.ppo)

    def _policy_loss(self, part: Batch) -> torch.Tensor:
        carry = part.hidden.transpose(0, 1), part.cell.transpose(0, 1)
        mean = self.policy.sequences(part.observation, carry, part.is_first)
        distribution = torch.distributions.Normal(mean, self.policy.log_std.exp(), validate_args=False)
        ratio = (distribution.log_prob(part.action).sum(-1) - part.log_prob).exp()
        clipped = ratio.clamp(1 - self.ppo.clip, 1 + self.ppo.clip)
        return -torch.minimum(ratio * part.advantage, clipped * part.advantage).mean()

    def _value_loss(self, part: Batch) -> torch.Tensor:
        return 0.5 * (self.value(part.observation) - part.target).square().mean()


class Trainer(Learner):
    """A learner with environments, and their state between iterations."""

    def __init__(
        self, envs: gymnasium.vector.VectorEnv, ppo: PPOConfig, hidden_size: int, initial_log_std: float, seed: int
    ):
        observation_size = envs.single_observation_space.shape[0]  # type: ignore[index]
        action_size = envs.single_action_space.shape[0]  # type: ignore[index]
        super().__init__(observation_size, action_size, ppo, hidden_size, initial_log_std, seed)
        self.envs = envs
        self.observation, _ = envs.reset(seed=seed)
        self.is_first = np.ones(envs.num_envs, bool)
        self.carry: Carry = (torch.zeros(2, envs.num_envs, hidden_size), torch.zeros(2, envs.num_envs, hidden_size))

    @torch.no_grad()
    def collect(self, horizon: int, unroll: int) -> Batch:
        """`horizon` steps of every environment, cut into sequences of `unroll` steps."""
        num_envs, action_size = self.envs.num_envs, len(self.policy.log_std)
        observation = torch.empty(horizon + 1, num_envs, self.observation.shape[1])
        is_first, terminated, truncated = torch.zeros(3, horizon, num_envs, dtype=torch.bool)
        reward, final_value = torch.zeros(2, horizon, num_envs)
        noise, action = torch.randn(horizon, num_envs, action_size), torch.empty(horizon, num_envs, action_size)
        carries, cuts = [], []
        std = self.policy.log_std.exp()
        for t in range(horizon):
            observation[t], is_first[t] = torch.from_numpy(self.observation), torch.from_numpy(self.is_first)
            if t % unroll == 0:
                carries.append(self.carry)
            mean, self.carry = self.policy.step(observation[t], self.carry, is_first[t])
            action[t] = mean + std * noise[t]
            self.observation, rewards, ends, limits, info = self.envs.step(action[t].numpy())
            reward[t] = torch.from_numpy(rewards)
            terminated[t], truncated[t] = torch.from_numpy(ends), torch.from_numpy(limits)
            self.is_first = ends | limits
            cuts += [(t, env, info["final_obs"][env]) for env in np.flatnonzero(limits & ~ends).tolist()]
        observation[horizon] = torch.from_numpy(self.observation)
        value = self.value(observation)
        if cuts:
            times, envs, finals = zip(*cuts, strict=True)
            final_value[list(times), list(envs)] = self.value(torch.from_numpy(np.stack(finals)))
        ended = terminated | truncated
        following = torch.where(ended, final_value, value[1:])
        delta = reward + self.ppo.discount * following - value[:-1]
        log_prob = torch.distributions.Normal(0.0, 1.0).log_prob(noise).sum(-1) - self.policy.log_std.sum()

        def rows(array: torch.Tensor) -> torch.Tensor:  # [horizon, n, ...] to [B, T, ...]
            return array.transpose(0, 1).reshape(num_envs * horizon // unroll, unroll, *array.shape[2:])

        advantage = _advantage(rows(delta), rows(ended), self.ppo.discount * self.ppo.gae_lambda)
        hidden, cell = (torch.stack(states, dim=2).movedim(0, 2).flatten(0, 1) for states in zip(*carries, strict=True))
        target = advantage + rows(value[:-1])
        if self.ppo.standardize_advantages:
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        steps = rows(observation[:-1]), rows(action), rows(log_prob), rows(is_first)
        return Batch(*steps, hidden, cell, advantage, target)


def noise(learner: Learner, rows: int, steps: int, hidden_size: int) -> Batch:
    """`rows` whole sequences of `steps` random steps, to time an update with."""
    policy, shape = learner.policy, (rows, steps)
    is_first = torch.zeros(shape, dtype=torch.bool)
    is_first[:, 0] = True
    action = torch.randn(*shape, len(policy.log_std))
    return Batch(
        observation=torch.randn(*shape, policy.lstm.input_size),
        action=action,
        log_prob=torch.distributions.Normal(0.0, 1.0).log_prob(action).sum(-1),
        is_first=is_first,
        hidden=torch.zeros(rows, 2, hidden_size),
        cell=torch.zeros(rows, 2, hidden_size),
        advantage=torch.randn(shape),
        target=torch.randn(shape),
    )


def _keep(carry: Carry, where: torch.Tensor) -> Carry:
    """The carry, zeroed where `where` [B] is False."""
    keep = where.to(torch.float32)[:, None]
    return carry[0] * keep, carry[1] * keep


def _advantage(delta: torch.Tensor, ended: torch.Tensor, decay: float) -> torch.Tensor:
    """Generalised advantage estimates [B, T]; each row ends with a bootstrap."""
    advantage, later = torch.empty_like(delta), torch.zeros(len(delta))
    for t in reversed(range(delta.shape[1])):
        later = delta[:, t] + decay * ~ended[:, t] * later
        advantage[:, t] = later
    return advantage


def _descend(network: nn.Module, optimizer: torch.optim.Optimizer, loss: torch.Tensor, ppo: PPOConfig) -> None:
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), ppo.max_gradient_norm)
    optimizer.step()
