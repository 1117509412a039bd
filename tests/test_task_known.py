"""The privileged control whose context is the task itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tcmrl_algo.algorithms.task_known import KnownTask
from tcmrl_algo.methods.base import METHODS
from tcmrl_data import Batch, TrainingError
from tests.made_up import OBSERVATION_DIM, batch_for, problem, settings, steps


def test_the_context_of_a_task_is_its_standardised_parameters() -> None:
    made = problem(privileged=True)
    learner = KnownTask(made)
    kinds = {"policy": steps(3, 5, seed=1)}
    found = learner.losses(Batch(torch.tensor([9, 2, 5]), kinds), 1, made.generator(1))
    assert found.context is not None and made.privileged is not None
    assert torch.equal(found.context, made.privileged[[2, 0, 1]])
    assert (learner.latent, float(found.total)) == (2, 0.0)
    assert torch.equal(learner.known_context(made.privileged), made.privileged)


def test_it_acts_by_the_parameters_alone_and_in_training_as_in_evaluation() -> None:
    method, made, tables = METHODS.get("task_known")(), problem(privileged=True), settings()
    algorithm = method.create(made, tables, method.Config())
    request = method.batch_request(tables, method.Config())
    assert set(request.kinds) == {"policy"}
    for step in range(1, 4):
        algorithm.update(batch_for(request, seed=step), step)
    states = np.ones((3, OBSERVATION_DIM), dtype=np.float32)
    noise = np.zeros((3, 2), dtype=np.float32)
    assert made.privileged is not None
    acts = algorithm.adapt([[], [], []], privileged=made.privileged).act(states, noise)
    assert len({tuple(row) for row in acts.round(6)}) == 3
    mean_task = algorithm.adapt([[]], privileged=torch.zeros(1, 2)).act(states[:1], noise[:1])
    np.testing.assert_array_equal(algorithm.adapt([[]]).act(states[:1], noise[:1]), mean_task)


def test_tasks_without_parameters_are_refused() -> None:
    with pytest.raises(TrainingError, match="tasks of made-up have no parameters"):
        KnownTask(replace(problem(), privileged=torch.zeros(3, 0)))
