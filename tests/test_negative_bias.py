"""`tcmrl.negative_bias`: L_neg towards rewards that are wrong on average."""

from typing import Any

import pytest
import torch
from torch import Tensor

from tcmrl_algo.algorithms.tcmrl import TcmrlConfig, TcmrlLearner, Weights
from tests.context_learners import learner_of, losses_of
from tests.made_up import EPISODE, batch, problem, settings

SMALL: dict[str, Any] = {"latent": 4, "encoder_hidden": (8,), "tce_hidden": (8,), "estimator_hidden": (8,)}
NEGATIVE_ALONE = {
    "weights": dict.fromkeys(Weights.model_fields, 0.0) | {"negative": 1.0},
    "estimator_training": "positive",
}


def negative(*, sparse: bool = False, **config: Any) -> tuple[float, Tensor]:
    """L_neg of a batch without padding, and its gradient."""
    table = TcmrlConfig.model_validate(SMALL | NEGATIVE_ALONE | config)
    learner = TcmrlLearner(problem(sparse=sparse), settings(), table)
    loss = losses_of(learner, batch(lengths=None)).total
    loss.backward()  # type: ignore[no-untyped-call]
    gradients = [value.grad.flatten() for value in learner.parameters() if value.grad is not None]
    return loss.item(), torch.cat(gradients)


def test_the_default_is_noise_of_mean_zero() -> None:
    assert TcmrlConfig().negative_bias == 0.0


def test_a_bias_changes_the_negative_loss_alone() -> None:
    first, second = (
        losses_of(learner_of(TcmrlLearner, "tcmrl", SMALL | {"negative_bias": bias})).metrics
        for bias in (0.0, 1.0)
    )
    assert {name for name, value in first.items() if not torch.equal(value, second[name])} == {
        "loss/negative"
    }


@pytest.mark.parametrize("sparse", [False, True])
def test_the_gradient_is_linear_in_the_bias_and_not_that_of_the_true_rewards(sparse: bool) -> None:
    """Of (r_hat - r' - b)^2 with respect to r_hat it is 2 (r_hat - r') - 2 b."""
    found = {
        bias: negative(sparse=sparse, negative_noise=0.0, negative_bias=bias)[1] for bias in (-1.0, 0.0, 1.0)
    }
    torch.testing.assert_close((found[1.0] + found[-1.0]) / 2, found[0.0], rtol=1e-4, atol=1e-6)
    assert (found[1.0] - found[0.0]).abs().max() > 1e-3


@pytest.mark.parametrize("sparse", [False, True])
def test_a_bias_is_in_standard_deviations_of_a_steps_reward(sparse: bool) -> None:
    """Returns are divided by the horizon: the bias of a whole episode is b, that of its steps b / horizon."""
    plain, biased = (
        negative(sparse=sparse, negative_noise=0.0, negative_bias=bias)[0] for bias in (0.0, 50.0)
    )
    assert EPISODE == 6
    assert biased == pytest.approx(50.0**2, rel=0.1)  # (r_hat - r' - 50)^2 with r_hat - r' near 0
    assert plain < 10.0


def test_noise_lies_around_the_bias() -> None:
    """As 50 is the mean of the noise in every step, so is it of the targets, whatever the noise's width."""
    narrow, wide = (negative(negative_noise=noise, negative_bias=50.0)[0] for noise in (0.0, 0.5))
    assert wide == pytest.approx(narrow, rel=0.02) and wide != narrow
