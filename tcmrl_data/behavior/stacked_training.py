"""Training of a group of tasks in lockstep: one environment step of every task, then one joint update.

Every random stream belongs to one task, so an agent draws the same numbers in any group.
"""

import copy
import functools
from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from tcmrl_data.behavior.base import BehaviorContext, Snapshot, TrainingState
from tcmrl_data.behavior.stacked import StackedSettings
from tcmrl_data.behavior.stacked_learner import ReplayBatch, StackedSac
from tcmrl_data.envs.rollout import BoolArray, FloatArray
from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.foundation.seeding import Purpose, keyed_generator, keyed_seed


@final
class KeyedEpisodes:
    """One current episode per task; the n-th training episode of a task has its own keyed seed.

    Attributes:
        observations: the policies' current observations, (N, observation_dim) float32.
        numbers: numbers of the current episodes, (N,).
        lengths: steps of the current episodes so far, (N,).
        actions: actions of the current episodes so far, (N, horizon, action_dim) float32.
    """

    def __init__(self, context: BehaviorContext) -> None:
        environment, num_tasks = context.environment, len(context.tasks)
        self._context = context
        self._lanes = environment.lanes([task.parameters for task in context.tasks], reward=context.reward)
        self.numbers, self.lengths = np.zeros((2, num_tasks), dtype=np.int64)
        self.actions = np.zeros((num_tasks, environment.settings.horizon, environment.action_dim), np.float32)
        self.observations = self._see(self._lanes.reset([self._seed(lane) for lane in range(num_tasks)]))

    def step(self, actions: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Steps all tasks and restarts ended episodes; returns next observations, rewards and terminated."""
        everywhere = np.ones(len(self.numbers), dtype=bool)
        step = self._lanes.step(actions, everywhere)
        seen = self._see(step.observations)
        self.actions[np.arange(len(actions)), self.lengths] = actions
        self.lengths += 1
        self.observations = seen.copy()
        for lane in np.flatnonzero(step.terminated | step.truncated):
            self.numbers[lane] += 1
            self.lengths[lane] = 0
            self._restart(int(lane))
        return seen, step.rewards, step.terminated

    def restore(self, numbers: Sequence[int], lengths: Sequence[int], actions: FloatArray) -> None:
        """Restores the current episodes by repeating their actions from their seeds."""
        self.numbers[:], self.lengths[:], self.actions[:] = numbers, lengths, actions
        for lane in range(len(self.numbers)):
            self._restart(lane)
        for t in range(self.lengths.max()):
            running = self.lengths > t
            seen = self._see(self._lanes.step(self.actions[:, t], running).observations)
            self.observations[running] = seen[running]

    def close(self) -> None:
        """Frees the simulators."""
        self._lanes.close()

    def _restart(self, lane: int) -> None:
        self.observations[lane] = self._see(self._lanes.reset_lane(lane, self._seed(lane)))

    def _seed(self, lane: int) -> int:
        context = self._context
        key = (context.seed, context.environment.name, context.tasks[lane].index)
        return keyed_seed(*key, Purpose.BEHAVIOR_RESET, int(self.numbers[lane]))

    def _see(self, full: FloatArray) -> FloatArray:
        environment = self._context.environment
        seen = full if self._context.observation == "full" else environment.stored_view(full)
        return seen.astype(np.float32)


@final
class StackedReplay:
    """N replay buffers in one array; they fill in lockstep, and new rows overwrite the oldest.

    A row is (observation, action, next observation, reward, terminated), so that one gather reads a batch.
    """

    def __init__(self, num_tasks: int, capacity: int, dims: tuple[int, int], device: torch.device) -> None:
        observation_dim, action_dim = dims
        self._splits = [observation_dim, action_dim, observation_dim, 1, 1]
        self.rows = torch.zeros((num_tasks, capacity, sum(self._splits)), device=device)
        self.steps_added = 0

    @property
    def size(self) -> int:
        """Number of stored transitions per task."""
        return min(self.steps_added, self.rows.shape[1])

    def add(self, *columns: FloatArray | BoolArray) -> None:
        """Adds one transition per task, given as its five (N, …) columns."""
        num_tasks, capacity, _ = self.rows.shape
        row = np.concatenate(
            [np.reshape(column, (num_tasks, -1)) for column in columns], axis=1, dtype=np.float32
        )
        self.rows[:, self.steps_added % capacity] = torch.from_numpy(row).to(self.rows.device)
        self.steps_added += 1

    def gather(self, positions: npt.NDArray[np.int64]) -> ReplayBatch:
        """The transitions at positions (N, B)."""
        num_tasks, capacity, width = self.rows.shape
        flat = positions + capacity * np.arange(num_tasks)[:, None]
        index = torch.from_numpy(flat.reshape(-1)).to(self.rows.device)
        rows = self.rows.view(-1, width).index_select(0, index).view(*positions.shape, width)
        observations, actions, next_observations, rewards, terminated = rows.split(self._splits, dim=-1)
        return ReplayBatch(
            observations, actions, next_observations, rewards.squeeze(-1), terminated.squeeze(-1)
        )


@final
class GroupTraining:
    """N untrained agents and their environments."""

    def __init__(self, context: BehaviorContext, settings: StackedSettings) -> None:
        if settings.device == "cuda" and not torch.cuda.is_available():
            raise BuildError("behavior.stacked.device is 'cuda', but torch finds no CUDA device; use 'cpu'")
        environment, tasks = context.environment, context.tasks
        dims = (environment.observation_dim, environment.action_dim)
        self._context, self._settings, self._dims = context, settings, dims
        self._device = torch.device(settings.device)
        self.steps = 0
        self.learner = StackedSac(len(tasks), *dims, settings=settings, device=self._device)
        self._replay = StackedReplay(
            len(tasks), min(settings.buffer_size, settings.steps), dims, self._device
        )
        for agent, generator in enumerate(self._generators(Purpose.BEHAVIOR)):
            self.learner.initialize(agent, functools.partial(_uniform, generator))
        self._acting = self._generators(Purpose.BEHAVIOR_ACTION)
        self._updating = self._generators(Purpose.BEHAVIOR_UPDATE)
        self._episodes = KeyedEpisodes(context)

    def _generators(self, purpose: Purpose) -> list[np.random.Generator]:
        seed, name = self._context.seed, self._context.environment.name
        return [keyed_generator(seed, name, task.index, purpose) for task in self._context.tasks]

    def close(self) -> None:
        """Frees the simulators."""
        self._episodes.close()

    def advance(self) -> None:
        """Takes one environment step of every task, and the updates that are due after it."""
        observations = self._episodes.observations
        actions = self._act(observations)
        next_observations, rewards, terminated = self._episodes.step(actions)
        self._replay.add(observations, actions, next_observations, rewards, terminated)
        self.steps += 1
        if self.steps > self._settings.warmup and self.steps % self._settings.train_frequency == 0:
            for _ in range(self._settings.gradient_steps):
                self.learner.update(*self._draw())

    def _act(self, observations: FloatArray) -> FloatArray:
        action_dim = self._dims[1]
        if self.steps < self._settings.warmup:
            actions = [generator.uniform(-1.0, 1.0, action_dim) for generator in self._acting]
            return np.stack(actions).astype(np.float32)
        noise = [generator.standard_normal(action_dim, dtype=np.float32) for generator in self._acting]
        return self.learner.act(self._tensor(observations), self._tensor(np.stack(noise))).cpu().numpy()

    def _draw(self) -> tuple[ReplayBatch, Tensor]:
        """Draws a batch with replacement, and the noise of one update."""
        batch_size, action_dim = self._settings.batch_size, self._dims[1]
        positions = np.empty((len(self._updating), batch_size), dtype=np.int64)
        noise = np.empty((len(self._updating), 2 * batch_size, action_dim), dtype=np.float32)
        for agent, generator in enumerate(self._updating):
            positions[agent] = generator.integers(self._replay.size, size=batch_size)
            generator.standard_normal(dtype=np.float32, out=noise[agent])
        return self._replay.gather(positions), self._tensor(noise)

    def _tensor(self, array: npt.NDArray[Any]) -> Tensor:
        return torch.from_numpy(array).to(self._device)

    def snapshot(self, agent: int) -> Snapshot:
        """A snapshot of one agent's current policy."""
        layers = self.learner.actors.layers
        arrays = [(layer.weight[agent].cpu().numpy(), layer.bias[agent, 0].cpu().numpy()) for layer in layers]
        named = {f"hidden.{index}": pair for index, pair in enumerate(arrays[:-1])}
        (mean_weight, log_std_weight), (mean_bias, log_std_bias) = (
            np.split(array, 2) for array in arrays[-1]
        )
        named |= {"mean": (mean_weight, mean_bias), "log_std": (log_std_weight, log_std_bias)}
        tensors = {
            f"{name}.{kind}": array.copy()
            for name, pair in named.items()
            for kind, array in zip(("weight", "bias"), pair, strict=True)
        }
        return Snapshot.of_network(self.steps, self._context.observation, tensors)

    def capture(self, *, failed: Mapping[int, int]) -> TrainingState:
        """Captures the complete state of the training, at any step.

        Args:
            failed: by task index, the first snapshot step whose policy was not finite.
        """
        arrays = {f"learner.{name}": tensor.cpu().numpy() for name, tensor in self.learner.state().items()}
        arrays["replay"] = np.ascontiguousarray(self._replay.rows[:, : self._replay.size].cpu().numpy())
        arrays["episodes.actions"] = self._episodes.actions
        values = {
            "steps": self.steps,
            "failed": {str(task): step for task, step in failed.items()},
            "episodes": {
                "numbers": self._episodes.numbers.tolist(),
                "lengths": self._episodes.lengths.tolist(),
            },
            "acting": [copy.deepcopy(generator.bit_generator.state) for generator in self._acting],
            "updating": [copy.deepcopy(generator.bit_generator.state) for generator in self._updating],
        }
        return TrainingState(values, arrays)

    def restore(self, checkpoint: TrainingState) -> None:
        """Restores a checkpoint, so that training continues bit for bit."""
        values, arrays = checkpoint.values, checkpoint.arrays
        self.steps = self._replay.steps_added = values["steps"]
        for name, tensor in self.learner.state().items():
            tensor.copy_(torch.from_numpy(arrays[f"learner.{name}"]).reshape(tensor.shape))
        self._replay.rows[:, : self._replay.size] = self._tensor(arrays["replay"])
        self._episodes.restore(**values["episodes"], actions=arrays["episodes.actions"])
        for name, generators in (("acting", self._acting), ("updating", self._updating)):
            for generator, state in zip(generators, values[name], strict=True):
                generator.bit_generator.state = state


def _uniform(generator: np.random.Generator, shape: tuple[int, ...]) -> Tensor:
    return torch.from_numpy(generator.uniform(-1.0, 1.0, shape).astype(np.float32))
