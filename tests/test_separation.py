"""Whether methods tell the tasks of a real dataset apart after a short training."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tcmrl_algo import create_algorithm, open_run, resolve_for, train_run
from tcmrl_algo.algorithms.core.context import ContextAlgorithm
from tcmrl_algo.algorithms.unicorn import UnicornLearner
from tcmrl_data import Dataset, Trajectory

STEPS = 600
SETTINGS = (
    f"run.steps={STEPS}",
    f"run.checkpoint_every={STEPS}",
    "batch.transitions=16",
    "actor_critic.hidden=[8]",
    "optimizer.learning_rate=3e-3",
)
SUPERVISED = "unicorn.mode=sup"
PERCEPTRON = "focal_plus.attention=none"
# Of the steps, the encoder gets its share alone, and every task gives few pairs to a batch of four tasks.
CORRO = ("optimizer.learning_rate=1e-3", "corro.encoder_share=0.7", "corro.pairs_per_task=32")
VAE, RANDOMISED = "corro.negatives=cvae", "corro.negatives=reward_noise"
GROUPS = 3


def trained(dataset: Dataset, folder: Path, name: str, *more: str) -> ContextAlgorithm:
    config = resolve_for(dataset, profile="quick", algorithm=name, overrides=(*SETTINGS, *more))
    train_run(dataset, folder, config=config, profile="quick")
    run = open_run(folder)
    algorithm = create_algorithm(run.record, dataset)
    algorithm.load_tensors(run.newest().tensors())
    assert isinstance(algorithm, ContextAlgorithm)
    return algorithm


def groups_of(dataset: Dataset, task: int) -> list[list[Trajectory]]:
    """Disjoint groups of all stored trajectories of a task."""
    stored = dataset.select(tasks=[task]).trajectories(task)
    order = np.random.default_rng(task).permutation(len(stored)).reshape(GROUPS, -1)
    return [[stored[index] for index in group] for group in order]


@pytest.mark.parametrize(
    ("name", "more"),
    [
        pytest.param("focal", (), marks=pytest.mark.check),
        *(
            pytest.param(name, more, marks=pytest.mark.sweep)
            for name, more in [
                ("focal_plus", ()),
                ("focal_plus", (PERCEPTRON,)),
                ("csro", ()),
                ("corro", (*CORRO, VAE)),
                ("corro", (*CORRO, RANDOMISED)),
                ("unicorn", ()),
                ("unicorn", (SUPERVISED,)),
            ]
        ),
    ],
)
def test_contexts_of_stored_trajectories_lie_nearest_to_their_own_task(
    tiny: Dataset, tmp_path: Path, name: str, more: tuple[str, ...]
) -> None:
    algorithm = trained(tiny, tmp_path / "run", name, *more)
    found = torch.stack([algorithm.context(groups_of(tiny, task.index)) for task in tiny.train_tasks])
    right = []
    for group in range(GROUPS):
        others = [index for index in range(GROUPS) if index != group]
        distances = torch.cdist(found[:, group], found[:, others].mean(dim=1))
        right.append(distances.argmin(dim=1) == torch.arange(len(found)))
    assert torch.stack(right).float().mean() > 0.9


@pytest.mark.sweep
def test_unicorn_predicts_rewards_by_the_context_of_their_own_task(tiny: Dataset, tmp_path: Path) -> None:
    algorithm = trained(tiny, tmp_path / "run", "unicorn")
    learner = algorithm.learner
    assert isinstance(learner, UnicornLearner)
    lanes = [groups_of(tiny, task.index)[0] for task in tiny.train_tasks]
    with torch.no_grad():
        contexts, steps = algorithm.context(lanes), learner.encoder.read(algorithm.pack(lanes))

        def error(contexts: Tensor) -> float:
            spread = contexts[:, None, None].expand(*steps.mask.shape, -1)
            predicted, _ = learner.reward_decoder(torch.cat([spread, steps.state_actions], dim=-1))
            return float((predicted.squeeze(-1) - steps.rewards)[steps.mask].square().mean())

        assert error(contexts) < 0.5 * error(contexts.roll(1, dims=0))
