"""The privileged control whose context is the task itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tcmrl_algo.algorithms.controls import FourierFeatures, KnownTask
from tcmrl_algo.algorithms.core.method import METHODS
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


def test_parameters_are_embedded_where_asked() -> None:
    """Features are those of seed and parameters alone; contexts of training and evaluation agree."""
    made = problem(privileged=True)
    learner, again = KnownTask(made, embedding=16), KnownTask(made, embedding=16)
    assert made.privileged is not None
    found = learner.known_context(made.privileged)
    assert found.shape == (3, 16) and learner.latent == 16
    assert torch.equal(found, again.known_context(made.privileged))
    other = KnownTask(problem(seed=1, privileged=True), embedding=16)
    assert not torch.equal(found, other.known_context(made.privileged))
    kinds = {"policy": steps(3, 5, seed=1)}
    trained = learner.losses(Batch(torch.tensor([9, 2, 5]), kinds), 1, made.generator(1)).context
    assert trained is not None and torch.equal(trained, found[[2, 0, 1]])
    blind = learner.context(steps(2, 1, 6, seed=2))
    torch.testing.assert_close(blind, learner.known_context(torch.zeros(2, 2)))
    assert not list(learner.parameters())  # nothing to overfit
    assert {name.split(".")[0] for name in learner.state_dict()} == {"embedding"}


@pytest.mark.parametrize("parameters", [1, 41])
def test_products_of_features_estimate_a_kernel_as_wide_as_the_parameters_are_many(parameters: int) -> None:
    features = FourierFeatures(parameters, 20_000, generator=torch.Generator().manual_seed(0))
    tasks = torch.randn(3, parameters, generator=torch.Generator().manual_seed(1))
    values = features(tasks)
    expected = (-torch.cdist(tasks, tasks).square() / (2 * parameters)).exp()
    torch.testing.assert_close(values @ values.T / values.shape[1], expected, rtol=0, atol=0.03)


def test_an_embedded_control_goes_on_from_its_tensors() -> None:
    method, tables = METHODS.get("task_known")(), settings()
    config = method.Config.model_validate({"embedding": 16})
    request = method.batch_request(tables, config)
    straight, other = (method.create(problem(privileged=True, seed=seed), tables, config) for seed in (0, 1))
    straight.update(batch_for(request, seed=1), 1)
    other.load_tensors(straight.tensors())
    known = problem(privileged=True).privileged
    states, noise = np.ones((3, OBSERVATION_DIM), dtype=np.float32), np.zeros((3, 2), dtype=np.float32)
    acts = [made.adapt([[], [], []], privileged=known).act(states, noise) for made in (straight, other)]
    np.testing.assert_array_equal(*acts)
    assert len({tuple(row) for row in acts[0].round(6)}) == 3
