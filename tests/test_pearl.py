"""PEARL in batch mode: posterior, prior, the critics' gradient, and the draws of episodes."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tcmrl_algo.algorithms.core.losses import gaussian_divergence
from tcmrl_algo.algorithms.core.problem import pad_trajectories
from tcmrl_algo.algorithms.pearl import PearlLearner, product_of_gaussians
from tests.context_learners import algorithm_of, gradients, learner_of, losses_of, moved
from tests.made_up import batch, problem, trajectory

SMALL: dict[str, Any] = {"latent": 4, "encoder_hidden": (8,)}
STATES, NOISE = np.ones((2, 3), dtype=np.float32), np.zeros((2, 2), dtype=np.float32)


def learner(**config: Any) -> PearlLearner:
    return learner_of(PearlLearner, "pearl", SMALL | config)


def values(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64).view(1, -1, 1)


def divergence(*numbers: float) -> float:
    return gaussian_divergence(*torch.tensor(numbers).view(4, 1, 1).unbind()).item()


def test_product_of_gaussians_by_hand() -> None:
    """N(0, 1) N(2, 1) is N(1, 1/2); n equal factors N(m, v) are N(m, v / n)."""
    both = torch.ones(1, 2) > 0
    mean, variance = product_of_gaussians(values(0.0, 2.0), values(1.0, 1.0), both)
    assert (mean.item(), variance.item()) == (1.0, 0.5)
    mean, variance = product_of_gaussians(
        values(3.0, 3.0, 9.0), values(0.4, 0.4, 0.1), values(1, 1, 0)[..., 0] > 0
    )
    assert (mean.item(), variance.item()) == (pytest.approx(3.0), pytest.approx(0.2))


def test_product_without_a_factor_is_the_prior() -> None:
    mean, variance = product_of_gaussians(values(5.0), values(0.1), torch.zeros(1, 1) > 0)
    assert (mean.item(), variance.item()) == (0.0, 1.0)
    mean, variance = product_of_gaussians(torch.zeros(2, 0, 3), torch.zeros(2, 0, 3), torch.zeros(2, 0) > 0)
    assert torch.equal(mean, torch.zeros(2, 3)) and torch.equal(variance, torch.ones(2, 3))


@pytest.mark.parametrize(
    ("numbers", "expected"),
    [
        ((1.0, 1.0, 0.0, 1.0), 0.5),
        ((0.0, 2.0, 0.0, 1.0), 0.153426),
        ((0.0, 0.5, 0.0, 1.0), 0.096574),
        ((0.0, 1.0, 1.0, 2.0), 0.346574),
        ((0.7, 0.3, 0.7, 0.3), 0.0),
    ],
)
def test_divergence_of_gaussians_by_hand(numbers: tuple[float, ...], expected: float) -> None:
    assert divergence(*numbers) == pytest.approx(expected, abs=1e-6)


def test_gradients_of_gaussians_are_right() -> None:
    def random(*shape: int, seed: int) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        return torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_()

    mask = torch.tensor([[True, True, True], [True, True, False]])
    given = (random(2, 3, 4, seed=0), random(2, 3, 4, seed=1))
    assert torch.autograd.gradcheck(
        lambda mean, free: torch.cat(product_of_gaussians(mean, free.exp(), mask)), given
    )
    four = tuple(random(2, 4, seed=seed) for seed in range(4))
    assert torch.autograd.gradcheck(lambda a, b, c, d: gaussian_divergence(a, b.exp(), c, d.exp()), four)


def test_the_loss_is_the_weighed_divergence_summed_over_tasks() -> None:
    made = learner(kl_weight=0.1, prior_std=2.0)
    found = losses_of(made)
    mean, variance = made.posterior(batch()["context"])
    terms = 0.5 * (variance / 4 + mean.square() / 4 - 1 - (variance / 4).log())
    torch.testing.assert_close(found.total, 0.1 * terms.sum())


def test_q_trains_the_encoder_and_v_and_the_policy_do_not() -> None:
    made = algorithm_of("pearl", SMALL | {"kl_weight": 0.0})
    found, generator = losses_of(made.learner), torch.Generator().manual_seed(0)
    assert found.context is not None
    rows = made.actor_critic.rows(batch()["policy"], found.context, critic_gradient=found.critic_gradient)
    _, metrics = made.actor_critic.losses(rows, generator)
    encoder = gradients(made.learner, metrics["loss/critic"], ("encoder",))
    assert encoder["encoder"] > 1e-7
    for name in ("loss/value", "loss/policy"):
        assert gradients(made.learner, metrics[name], ("encoder",))["encoder"] == 0.0, name
    assert moved(made) == {"encoder"}


def test_more_transitions_narrow_the_posterior() -> None:
    made, lanes = learner(), [[trajectory(6, 0)], [trajectory(6, 0), trajectory(4, 1)]]
    _, variance = made.posterior(pad_trajectories(lanes, problem()))
    assert (variance[1] < variance[0]).all()


def test_a_sample_depends_on_the_number_of_trajectories_and_the_mean_does_not() -> None:
    once, twice = [trajectory(6, 0)], [trajectory(6, 0), trajectory(6, 0)]
    steps = pad_trajectories([once, twice, once], problem())
    made, mean = learner(), learner(test_context="mean")
    found, middle = made.context(steps), mean.context(steps)
    torch.testing.assert_close(middle[1], middle[0])
    noise = (found - middle) / made.posterior(steps)[1].sqrt()
    assert torch.equal(found[0], found[2])
    assert (noise[0] - noise[1]).abs().min() > 1e-3
    draws = torch.stack([made._noise(torch.tensor([number]))[0] for number in range(500)])
    assert draws.mean().item() == pytest.approx(0.0, abs=0.07)
    assert draws.std().item() == pytest.approx(1.0, abs=0.07)


def test_without_trajectories_contexts_come_from_the_prior() -> None:
    made = learner(prior_std=0.5)
    nothing = pad_trajectories([[], []], problem())
    mean, variance = made.posterior(nothing)
    assert torch.equal(mean, torch.zeros(2, 4)) and torch.equal(variance, torch.full((2, 4), 0.25))
    assert torch.equal(learner(test_context="mean").context(nothing), torch.zeros(2, 4))


def test_it_collects_under_contexts_from_the_prior_that_change_by_lane_and_episode() -> None:
    made = algorithm_of("pearl", SMALL)
    first = made.explore([[], []]).act(STATES, NOISE)
    again = made.explore([[], []]).act(STATES, NOISE)
    np.testing.assert_array_equal(first, again)
    assert not np.allclose(first[0], first[1])
    many = made.explore([[] for _ in range(50)]).act(np.repeat(STATES[:1], 50, axis=0), NOISE)
    np.testing.assert_allclose(many[0], first[0], rtol=1e-5)  # however many other lanes there are
    lanes = [[trajectory(6, 0)], [trajectory(6, 1)]]
    others = [[trajectory(6, 2)], [trajectory(6, 3)]]
    second = made.explore(lanes).act(STATES, NOISE)
    assert not np.allclose(first, second)
    np.testing.assert_array_equal(second, made.explore(others).act(STATES, NOISE))  # the prior knows no data
