"""CSRO: which of its losses trains which network, q(z | s, a), contexts, and how it collects."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tcmrl_algo.algorithms.core.losses import distance_metric_loss
from tcmrl_algo.algorithms.core.networks import mean_representation
from tcmrl_algo.algorithms.core.settings import RunSettings
from tcmrl_algo.algorithms.csro import ClubNetwork, CsroConfig, CsroLearner, club_penalty
from tcmrl_data import UniformController
from tests.context_learners import algorithm_of, gradients, learner_of, losses_of, moved
from tests.made_up import TASKS, batch, trajectory, with_steps

SMALL: dict[str, Any] = {"latent": 4, "encoder_hidden": (8,), "club_hidden": (8,)}
PARTS = ("encoder", "club")


def learner(**config: Any) -> CsroLearner:
    return learner_of(CsroLearner, "csro", SMALL | config)


def test_the_likelihood_trains_q_alone_and_the_rest_the_encoder_alone() -> None:
    made = learner()
    found = gradients(made, losses_of(made).total, PARTS)
    assert found["encoder"] > 1e-6 and found["club"] == 0.0
    before = {name: value.clone() for name, value in made.state_dict().items()}
    losses_of(made)  # one step of q's own Adam
    changed = {name for name, value in made.state_dict().items() if not torch.equal(value, before[name])}
    assert {name.split(".")[0] for name in changed} == {"club"}
    assert all(parameter.grad is None for parameter in made.encoder.parameters())


def test_an_update_moves_both_networks_and_keeps_the_state_of_both_optimizers() -> None:
    made = algorithm_of("csro", SMALL)
    assert moved(made) == {"encoder", "club"}
    names = [name for name in made.tensors() if name.startswith("optimizer")]
    assert any(name.startswith("optimizer/club/perceptron") for name in names)
    assert not [name for name in names if name.startswith("optimizer/train/context.club")]


@pytest.mark.parametrize("positives", ["none", "trajectories"])
def test_the_loss_weighs_the_penalty_under_the_new_q_and_the_distances(positives: str) -> None:
    made, values = learner(positives=positives, penalty=3.0, distance_weight=2.0), batch()
    found = losses_of(made, values)
    groups = [made.encoder.read(values[name]) for name in ("context", "execution")]
    representations = torch.cat(made.encoder(*groups), dim=1)
    mask = torch.cat([group.mask for group in groups], dim=1)
    inputs = torch.cat([group.state_actions for group in groups], dim=1)
    mean, variance = made.club(inputs.flatten(1, 2))
    penalty = club_penalty(representations.flatten(1, 2), mean, variance, mask.flatten(1, 2))
    single = torch.stack(
        [
            torch.stack([row[real].mean(dim=0) for row, real in zip(lane, steps, strict=True)])
            for lane, steps in zip(representations, mask, strict=True)
        ]
    )
    whole = mean_representation(representations.flatten(1, 2), mask.flatten(1, 2)).unsqueeze(1)
    distance = distance_metric_loss(whole if positives == "none" else single)
    torch.testing.assert_close(found.total, 3.0 * penalty + 2.0 * distance)
    torch.testing.assert_close(found.context, made.context(values["context"]))


def test_without_positives_no_distance_within_a_task_counts() -> None:
    contexts = torch.tensor([[[0.0]], [[0.9486833]]])  # d^2 = 0.9
    assert distance_metric_loss(contexts).item() == pytest.approx(1.0)
    assert distance_metric_loss(torch.zeros(2, 1, 3)).item() == pytest.approx(10.0)


def test_literal_variances_are_squashed_and_free_ones_are_not() -> None:
    given = torch.full((1, 3, 5), 100.0) * torch.tensor([-1.0, 0.0, 1.0]).view(1, 3, 1)
    for variance, bounds in (("literal", (0.313262, 1.313262)), ("softplus", (1e-4, 100.0))):
        config = CsroConfig(latent=4, club_hidden=(), variance=variance)
        network = ClubNetwork(5, config, generator=torch.Generator().manual_seed(0))
        (layer,) = network.perceptron.layers
        torch.nn.init.ones_(layer.weight)
        torch.nn.init.zeros_(layer.bias)
        mean, found = network(given)
        assert mean.abs().max() <= 1
        torch.testing.assert_close(found[0, 0, 0].item(), bounds[0], atol=1e-5, rtol=1e-5)
        assert found[0, 1, 0].item() == pytest.approx(0.693147, abs=2e-4)
        assert found[0, 2, 0].item() >= bounds[1] - 1e-5


def test_it_collects_uniformly_at_first_and_then_by_what_it_collected() -> None:
    made = algorithm_of("csro", SMALL | {"random_share": 0.5})
    half = (RunSettings().random_episodes + 1) // 2
    lanes = [[trajectory(6, lane)] * half for lane in range(2)]
    for collected in ([[], []], [lane[1:] for lane in lanes]):
        assert isinstance(made.explore(collected), UniformController)
    states, noise = np.ones((2, 3), dtype=np.float32), np.zeros((2, 2), dtype=np.float32)
    expected = made.adapt(lanes).act(states, noise)
    np.testing.assert_array_equal(made.explore(lanes).act(states, noise), expected)
    assert isinstance(algorithm_of("csro", SMALL | {"random_share": 1.0}).explore(lanes), UniformController)


@pytest.mark.check
def test_the_penalty_takes_out_of_representations_what_states_and_actions_tell() -> None:
    """Tasks that differ in states and rewards: what a linear probe reads of z_t from (s_t, a_t)."""
    offset = torch.arange(TASKS).view(TASKS, 1, 1) - 1.0
    values = batch(lengths=None)
    parts = {name: values[name] for name in ("context", "execution")}
    values = with_steps(
        values,
        **{
            name: replace(
                part,
                rewards=0.1 * part.rewards + offset,
                observations=part.observations + offset.unsqueeze(-1),
            )
            for name, part in parts.items()
        },
    )
    found = []
    for penalty in (0.0, 25.0):
        made = algorithm_of("csro", SMALL | {"penalty": penalty, "club_learning_rate": 1e-2})
        for step in range(1, 100):
            made.update(values, step)
        assert isinstance(made.learner, CsroLearner)
        read = made.learner.encoder.read(values["context"])
        with torch.no_grad():
            (representations,) = made.learner.encoder(read)
        found.append(explained(read.state_actions.flatten(0, 2), representations.flatten(0, 2)))
    assert found[1] < found[0] - 0.2


def explained(inputs: Tensor, outputs: Tensor) -> float:
    """The share of the outputs' variance that a linear function of the inputs explains."""
    inputs = torch.cat([inputs, torch.ones(len(inputs), 1)], dim=1)
    errors = outputs - inputs @ torch.linalg.lstsq(inputs, outputs).solution
    return 1.0 - float(errors.square().sum() / (outputs - outputs.mean(dim=0)).square().sum())
