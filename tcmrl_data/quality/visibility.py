"""How visible the task is in the transitions of a stage.

The reward and the change of the observation of a transition are predicted as the mean of those of its nearest
neighbours in (observation, action), once among transitions of the same task and once among as many of other
tasks. If the same task predicts better, something that the observation does not show differs between tasks.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.envs.trajectory import FloatArray
from tcmrl_data.foundation.seeding import NO_TASK, Purpose, keyed_generator
from tcmrl_data.quality.measured import SMALLEST_STD, MeasuredStage, PartSteps, by_stage, read_steps
from tcmrl_data.quality.transfer import TransferTask

NEIGHBOURS = 5
"""Nearest neighbours of a prediction."""

TRANSITIONS = 500
"""Most transitions of a part that are predicted, and most that predict, by default."""

SMALLEST_ERROR = 1e-12
"""Squared errors below this share of the mean square are zero but for rounding."""


class StageVisibility(MeasuredStage):
    """How visible the task is in the data of a stage.

    Attributes:
        tasks: number of tasks.
        rewarded: share of steps with a reward other than zero.
        reward: visibility in rewards: 1 − (squared error of predictions from the same task) / (from other
            tasks). 1 is plain to see, 0 is invisible; None where rewards cannot be told apart at all.
        dynamics: visibility in the changes of observations.
    """

    tasks: int
    rewarded: float
    reward: float | None
    dynamics: float | None


@dataclass(frozen=True)
class Half:
    """Transitions of half of a part's episodes.

    Attributes:
        inputs: (n, observation_dim + action_dim).
        rewards: (n, 1).
        changes: (n, observation_dim), next observation minus observation.
    """

    inputs: FloatArray
    rewards: FloatArray
    changes: FloatArray

    def rows(self, chosen: npt.NDArray[np.intp]) -> "Half":
        """Some of the transitions."""
        return Half(self.inputs[chosen], self.rewards[chosen], self.changes[chosen])


@dataclass(frozen=True)
class Sample:
    """Transitions of a part: `known` ones predict `asked` ones, and no episode has a part in both."""

    known: Half
    asked: Half
    rewarded: float


def measure_visibility(
    dataset: Dataset,
    tasks: Sequence[TransferTask],
    *,
    transitions: int = TRANSITIONS,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[StageVisibility]:
    """How visible the task is at every step of some tasks' runs, training and test tasks apart.

    Parts with fewer than two episodes are left out. Samples of the parts of one step are in memory.

    Args:
        dataset: the dataset.
        tasks: the tasks and their runs.
        transitions: most transitions of a part that are predicted, and most that predict.
        seed: of the samples.
        progress: called with parts done and parts in all.

    Raises:
        StoreError: a part is damaged.
    """
    keys = [
        (task.split, key) for task in tasks for key in dataset.parts.keys_of(task.task) if key.run == task.run
    ]
    done = 0
    for step, split, members in by_stage(keys):
        samples = []
        for key in members:
            generator = keyed_generator(seed, dataset.name, key.task, Purpose.VISIBILITY, step)
            sample = draw_sample(read_steps(dataset, key), transitions, generator)
            samples += [sample] if sample is not None else []
            done += 1
            if progress:
                progress(done, len(keys))
        if samples:
            generator = keyed_generator(seed, dataset.name, NO_TASK, Purpose.VISIBILITY, step)
            reward, dynamics = visibility(samples, generator)
            yield StageVisibility(
                step=step,
                split=split,
                tasks=len(samples),
                rewarded=float(np.mean([sample.rewarded for sample in samples])),
                reward=reward,
                dynamics=dynamics,
            )


def draw_sample(steps: PartSteps, most: int, generator: np.random.Generator) -> Sample | None:
    """At most `most` transitions of even episodes, which predict, and of odd ones; None if one is empty."""
    odd = np.repeat(np.arange(len(steps.lengths)) % 2 == 1, steps.lengths)
    halves = []
    for members in (np.flatnonzero(~odd), np.flatnonzero(odd)):
        if not len(members):
            return None
        chosen = np.sort(generator.choice(members, min(most, len(members)), replace=False))
        halves.append(
            Half(
                np.concatenate([steps.observations[chosen], steps.actions[chosen]], axis=1),
                steps.rewards[chosen, None],
                steps.next_observations[chosen] - steps.observations[chosen],
            )
        )
    return Sample(halves[0], halves[1], float(np.mean(steps.rewards != 0)))


def visibility(
    samples: Sequence[Sample], generator: np.random.Generator
) -> tuple[float | None, float | None]:
    """Visibility in rewards and in changes of observations: 1 − E_same / E_other.

    E_same sums the squared errors of predictions from the same task, E_other those from as many transitions
    of the other tasks; changes are summed over columns, in standard deviations. None with fewer than two
    tasks, and where the other tasks predict without error.

    Args:
        samples: one per task.
        generator: draws the transitions of other tasks.
    """
    if len(samples) < 2:
        return None, None
    pool = Half(
        *(
            np.concatenate([getattr(sample.known, name) for sample in samples])
            for name in ("inputs", "rewards", "changes")
        )
    )
    owner = np.repeat(np.arange(len(samples)), [len(sample.known.inputs) for sample in samples])
    scales = {name: _scale(getattr(pool, name)) for name in ("inputs", "rewards", "changes")}
    pool = _scaled(pool, scales)
    errors = np.zeros((2, 2))  # (same, other) x (rewards, changes)
    for task, sample in enumerate(samples):
        own, others = np.flatnonzero(owner == task), np.flatnonzero(owner != task)
        others = generator.choice(others, min(len(own), len(others)), replace=False)
        asked = _scaled(sample.asked, scales)
        errors[0] += _squared_errors(pool.rows(own), asked)
        errors[1] += _squared_errors(pool.rows(others), asked)
    nothing = SMALLEST_ERROR * sum(len(sample.asked.inputs) for sample in samples)
    reward, dynamics = (None if other <= nothing else float(1.0 - same / other) for same, other in errors.T)
    return reward, dynamics


def _scale(values: FloatArray) -> FloatArray:
    """One over the standard deviation of every column; 0 for columns that do not vary."""
    std = values.std(axis=0)
    varies = std > SMALLEST_STD * np.maximum(1.0, np.abs(values).max(axis=0))
    scale: FloatArray = np.where(varies, 1.0 / np.where(varies, std, 1.0), 0.0)
    return scale


def _scaled(half: Half, scales: dict[str, FloatArray]) -> Half:
    return Half(*(getattr(half, name) * scale for name, scale in scales.items()))


def _squared_errors(known: Half, asked: Half) -> tuple[float, float]:
    """Sums of squared errors of rewards and of changes, predicted by the nearest neighbours."""
    from scipy.spatial import KDTree

    neighbours = list(range(1, min(NEIGHBOURS, len(known.inputs)) + 1))
    _, found = KDTree(known.inputs).query(asked.inputs, k=neighbours)
    rewards = known.rewards[found].mean(axis=1) - asked.rewards
    changes = known.changes[found].mean(axis=1) - asked.changes
    return float(np.square(rewards).sum()), float(np.square(changes).sum())
