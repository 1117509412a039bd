"""CLUB and likelihoods against numbers computed by hand, with gradient checks."""

import math

import pytest
import torch

from tcmrl_algo.algorithms.csro import club_likelihood, club_penalty
from tcmrl_algo.algorithms.unicorn import gaussian_reconstruction, task_classification
from tests.made_up import random

MASK = torch.tensor([[True, True, True], [True, True, False]])


def test_gradients_are_right() -> None:
    given = (random(2, 3, 4), random(2, 3, 4, seed=1), random(2, 3, 4, seed=2))
    assert torch.autograd.gradcheck(lambda z, m, v: club_likelihood(z, m, v.exp(), MASK), given)
    assert torch.autograd.gradcheck(lambda z, m, v: club_penalty(z, m, v.exp(), MASK), given)
    assert torch.autograd.gradcheck(lambda z, m, v: gaussian_reconstruction(m, v, z, MASK), given)
    assert torch.autograd.gradcheck(
        lambda logits: task_classification(logits, torch.tensor([2, 0])), random(2, 3)
    )


def test_likelihood_by_hand() -> None:
    """z = mu and sigma^2 = 1: 0; z one sigma away: 1/2; the smallest literal variance: -0.5804."""
    one, mask = torch.ones(1, 2, 1), torch.tensor([[True, False]])
    far = torch.tensor([[[2.0], [torch.nan]]])
    assert club_likelihood(one, one, one, mask).item() == 0.0
    assert club_likelihood(far, one, one, mask).item() == pytest.approx(0.5)
    narrow = torch.full((1, 2, 1), 0.313262)
    assert club_likelihood(one, one, narrow, mask).item() == pytest.approx(-0.5804, abs=1e-4)


def test_penalty_of_two_representations_that_q_knows() -> None:
    """z = mu = (1, -1), sigma^2 = 1: P = 0 and N = -(0 + 4 + 4 + 0) / 4, so that P - N = 2."""
    values, ones = torch.tensor([[[1.0], [-1.0]]]), torch.ones(1, 2, 1)
    assert club_penalty(values, values, ones, torch.ones(1, 2) > 0).item() == pytest.approx(2.0)


def test_penalty_equals_the_mean_over_all_pairs_of_a_task() -> None:
    representations, mean = random(2, 3, 4).detach(), random(2, 3, 4, seed=1).detach()
    variance = random(2, 3, 4, seed=2).detach().exp()
    terms = []
    for task, real in enumerate(MASK):
        for i in real.nonzero().flatten():
            own = -((representations[task, i] - mean[task, i]) ** 2 / variance[task, i])
            pairs = [
                -((representations[task, j] - mean[task, i]) ** 2 / variance[task, i])
                for j in real.nonzero().flatten()
            ]
            terms.append((own - torch.stack(pairs).mean(dim=0)).mean())
    found = club_penalty(representations, mean, variance, MASK)
    torch.testing.assert_close(found, torch.stack(terms).mean())
    other = torch.where(MASK.unsqueeze(-1), representations, 77.0)
    torch.testing.assert_close(club_penalty(other, mean, variance, MASK), found)


def test_penalty_of_gaussians_is_twice_their_club() -> None:
    """z = rho x + sqrt(1 - rho^2) e, q exact: CLUB is rho^2 / (1 - rho^2) = 1.777778 at rho = 0.8."""
    draws = torch.randn(2, 1, 200_000, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    state, noise = draws
    rho, variance = 0.8, torch.full_like(state, 1 - 0.8**2)
    representations = rho * state + math.sqrt(1 - rho**2) * noise
    mask = torch.ones(1, 200_000, dtype=torch.bool)
    found = club_penalty(representations, rho * state, variance, mask)
    assert found.item() / 2 == pytest.approx(1.777778, rel=0.02)
    independent = club_penalty(noise, rho * state, variance, mask)
    assert abs(independent.item()) < 0.03


def test_reconstruction_by_hand() -> None:
    """(x - mu)^2 exp(-lv) + lv at (error, lv) = (0, 0), (1, 0) and (1, log 4): 0, 1 and 1/4 + log 4."""
    mask = torch.tensor([[True, False]])
    target = torch.tensor([[[1.0], [torch.nan]]])
    zero = torch.zeros(1, 2, 1)
    assert gaussian_reconstruction(zero + 1.0, zero, target, mask).item() == 0.0
    assert gaussian_reconstruction(zero, zero, target, mask).item() == 1.0
    wide = zero + math.log(4)
    assert gaussian_reconstruction(zero, wide, target, mask).item() == pytest.approx(0.25 + math.log(4))


def test_classification_of_uniform_logits_is_the_log_of_the_number_of_tasks() -> None:
    found = task_classification(torch.zeros(5, 40), torch.arange(5))
    assert found.item() == pytest.approx(3.688879, rel=1e-6)
