"""Losses against numbers computed by hand, with a double-precision gradient check for every loss."""

import math
from collections.abc import Callable
from typing import Literal

import pytest
import torch
from torch import Tensor

from tcmrl_algo.algorithms.core.actor_critic.sac import (
    cloning_loss,
    dual_divergence,
    gradient_penalty,
    policy_loss,
    value_loss,
)
from tcmrl_algo.algorithms.core.losses import distance_metric_loss, info_nce, masked_mean, q_loss
from tcmrl_algo.algorithms.tcmrl import (
    negative_return_loss,
    negative_reward_loss,
    positive_return_loss,
    positive_reward_loss,
    reverse_context,
    sparsity_loss,
    task_contrastive_loss,
)
from tcmrl_algo.algorithms.tcmrl_variants import (
    centered_sparsity_loss,
    entropy_sparsity_loss,
    extreme_rewards,
    literal_sparsity_loss,
    orthogonality_loss,
)
from tests.made_up import random

MASK = torch.tensor([[True, True, True], [True, True, False]])
FULL = torch.ones(2, 3, dtype=torch.bool)
NOISE = random(2, 3, seed=9).detach()
DIFFERENTIABLE: dict[str, tuple[Callable[..., Tensor], tuple[Tensor, ...]]] = {
    "masked_mean": (lambda x: masked_mean(x, MASK), (random(2, 3),)),
    "sparsity": (lambda x: sparsity_loss(x, MASK), (random(2, 3),)),
    "literal_sparsity": (lambda x: literal_sparsity_loss(x.square() + 0.1, MASK), (random(2, 3),)),
    "centered_sparsity": (lambda x: centered_sparsity_loss(x, MASK), (random(2, 3),)),
    "entropy_sparsity": (lambda x: entropy_sparsity_loss(x, MASK), (random(2, 3),)),
    "reverse_context": (
        lambda c, w: reverse_context(c, w, MASK).square().sum(),
        (random(2, 3, 4), random(2, 3, seed=1)),
    ),
    "positive_reward": (
        lambda p, r: positive_reward_loss(p, r, MASK),
        (random(2, 3), random(2, 3, seed=1)),
    ),
    "negative_reward": (
        lambda p, r: negative_reward_loss(p, r, MASK),
        (random(2, 3), random(2, 3, seed=1)),
    ),
    "positive_return": (
        lambda p, r: positive_return_loss(p, r, MASK),
        (random(2), random(2, 3, seed=1)),
    ),
    "negative_return": (
        lambda p, r: negative_return_loss(p, r, MASK),
        (random(2), random(2, 3, seed=1)),
    ),
    "info_nce": (
        lambda q, k: info_nce(q, k, MASK.T, temperature=0.7),
        (random(3, 2, 4), random(3, 2, 4, seed=1)),
    ),
    "task_contrastive": (
        lambda c, w: task_contrastive_loss(c, FULL.unsqueeze(1), w, window_length=2),
        (random(2, 1, 3, 4), random(4, 4, seed=1)),
    ),
    "distance_metric": (
        lambda c: distance_metric_loss(c),
        (random(2, 2, 4),),
    ),
    "distance_metric, root": (
        lambda c: distance_metric_loss(c, attraction="root"),
        (random(2, 2, 4),),
    ),
    "orthogonality": (orthogonality_loss, (random(2, 3),)),
    "q": (
        lambda q: q_loss(q, NOISE[0], torch.zeros(3).double(), NOISE[1], gamma=0.9),
        (random(2, 3),),
    ),
    "value": (lambda v: value_loss(v, NOISE[0]), (random(3),)),
    "policy": (lambda p, q: policy_loss(p, q, entropy=0.3), (random(3), random(3, seed=1))),
    "cloning": (
        lambda a: cloning_loss(a, torch.zeros(3, 2).double(), NOISE[0]),
        (random(3, 2),),
    ),
    "dual_divergence": (dual_divergence, (random(3), random(3, seed=1))),
    "gradient_penalty": (lambda g: gradient_penalty(2.0 * g), (random(3, 4),)),
}


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_gradients_are_right(name: str) -> None:
    function, inputs = DIFFERENTIABLE[name]
    assert torch.autograd.gradcheck(function, inputs)


def test_masked_mean_leaves_padding_out() -> None:
    values = torch.tensor([[1.0, 2.0, torch.nan]])
    assert masked_mean(values, torch.tensor([[True, True, False]])).item() == 1.5
    assert masked_mean(values, torch.zeros(1, 3, dtype=torch.bool)).item() == 0.0


def test_sparsity_is_the_mean_sigmoid_of_real_scores() -> None:
    scores = torch.tensor([[0.0, math.log(3.0), 50.0]])  # sigmoid: 1/2, 3/4, (padding)
    mask = torch.tensor([[True, True, False]])
    assert sparsity_loss(scores, mask).item() == pytest.approx(0.625)


def test_literal_equation_6_is_one_with_zero_gradient_where_ours_has_one() -> None:
    scores = random(2, 3)
    masked = torch.where(MASK, scores, -torch.inf)
    literal = literal_sparsity_loss(torch.softmax(masked, dim=-1), MASK)
    assert literal.item() == pytest.approx(1.0)
    (gradient,) = torch.autograd.grad(literal, scores)
    assert gradient.abs().max() < 1e-15
    (gradient,) = torch.autograd.grad(sparsity_loss(scores, MASK), scores)
    assert gradient[MASK].min() > 0.01


def test_centered_sparsity_takes_the_mean_of_the_real_scores_off() -> None:
    # without their mean, log 3, the scores are log 9, 0, 0, -log 9; sigmoid: 9/10, 1/2, 1/2, 1/10
    scores = torch.tensor([[math.log(27.0), math.log(3.0), math.log(3.0), -math.log(3.0), 99.0]])
    mask = torch.tensor([[True, True, True, True, False]])
    assert centered_sparsity_loss(scores, mask).item() == pytest.approx(0.5)
    # of log 27, 0, 0 without their mean, log 3: log 9, -log 3, -log 3; sigmoid: 9/10, 1/4, 1/4
    scores, three = (
        torch.tensor([[math.log(27.0), 0.0, 0.0, 99.0]]),
        torch.tensor([[True, True, True, False]]),
    )
    assert centered_sparsity_loss(scores, three).item() == pytest.approx(1.4 / 3)
    equal = torch.full((1, 5), 7.0)
    assert centered_sparsity_loss(equal, mask).item() == pytest.approx(0.5)
    told_apart = torch.tensor([[400.0, 0.0, 0.0, 0.0, 0.0]])
    assert centered_sparsity_loss(told_apart, mask).item() == pytest.approx(0.25)


def test_entropy_sparsity_is_a_share_of_the_largest_entropy() -> None:
    scores = torch.tensor([[math.log(2.0), 0.0, 0.0, 9.0], [3.0, 3.0, 3.0, 3.0], [1.0, 0.0, 0.0, 0.0]])
    mask = torch.tensor([[True, True, True, False], [True] * 4, [True, False, False, False]])
    # weights 1/2, 1/4, 1/4: entropy 3/2 log 2, of log 3; equal weights: 1; a lane of one transition: 0
    expected = (1.5 * math.log(2.0) / math.log(3.0) + 1.0 + 0.0) / 3
    assert entropy_sparsity_loss(scores, mask).item() == pytest.approx(expected)


def test_entropy_sparsity_of_one_hot_weights_is_zero_with_finite_gradient() -> None:
    scores = torch.tensor([[900.0, 0.0, 0.0]], requires_grad=True)
    loss = entropy_sparsity_loss(scores, torch.tensor([[True, True, False]]))
    (gradient,) = torch.autograd.grad(loss, scores)
    assert loss.item() == 0.0
    assert gradient.isfinite().all()


@pytest.mark.parametrize("loss", [centered_sparsity_loss, entropy_sparsity_loss])
def test_no_bias_lowers_centered_or_entropy_sparsity(loss: Callable[..., Tensor]) -> None:
    scores = random(2, 3)
    shifted = loss(scores - 30.0, MASK).item()
    assert shifted == pytest.approx(loss(scores, MASK).item())
    assert sparsity_loss(scores - 30.0, MASK).item() < 1e-9  # the bias satisfies this one


def test_reverse_context_is_nearly_the_mean_of_many_representations() -> None:
    """c_neg = c_mean + (c_mean - c) / (T - 1), whatever the attention is."""
    representations, mask = random(2, 80, 4).detach().tanh(), torch.ones(2, 80, dtype=torch.bool)
    weights = torch.softmax(3.0 * random(2, 80, seed=1).detach(), dim=-1)
    mean = representations.mean(dim=1)
    context = torch.einsum("lt,ltd->ld", weights, representations)
    reverse = reverse_context(representations, weights, mask)
    torch.testing.assert_close(reverse, mean + (mean - context) / 79)
    literal = reverse_context(representations, weights, mask, literal=True)
    torch.testing.assert_close(literal, 79 * reverse)


def test_reverse_context_weighs_by_one_minus_attention() -> None:
    representations = torch.tensor([[[1.0, 0.0], [0.0, 1.0], [2.0, 2.0], [9.0, 9.0]]])
    weights = torch.tensor([[0.5, 0.25, 0.25, 0.0]])
    mask = torch.tensor([[True, True, True, False]])
    literal = reverse_context(representations, weights, mask, literal=True)
    torch.testing.assert_close(literal, torch.tensor([[2.0, 2.25]]))  # .5(1,0) + .75(0,1) + .75(2,2)
    divided = reverse_context(representations, weights, mask)
    torch.testing.assert_close(divided, torch.tensor([[1.0, 1.125]]))  # T - 1 = 2


def test_reverse_context_of_a_single_step_is_zero() -> None:
    result = reverse_context(torch.ones(1, 1, 2), torch.ones(1, 1), torch.ones(1, 1, dtype=torch.bool))
    torch.testing.assert_close(result, torch.zeros(1, 2))


@pytest.mark.parametrize(("kind", "expected"), [("max", 3.0), ("min", 1.0)])
def test_extreme_rewards(kind: Literal["max", "min"], expected: float) -> None:
    rewards, mask = torch.tensor([[1.0, 3.0, -7.0, 9.0]]), torch.tensor([[True, True, False, False]])
    torch.testing.assert_close(extreme_rewards(rewards, mask, kind=kind), torch.full((1, 4), expected))


@pytest.mark.parametrize("loss", [positive_reward_loss, negative_reward_loss])
def test_reward_losses_are_mean_squared_errors_of_real_steps(loss: Callable[..., Tensor]) -> None:
    predicted, target = torch.tensor([[1.0, 2.0, 9.0]]), torch.tensor([[0.0, 4.0, 0.0]])
    assert loss(predicted, target, torch.tensor([[True, True, False]])).item() == 2.5  # (1 + 4) / 2


@pytest.mark.parametrize("loss", [positive_return_loss, negative_return_loss])
def test_return_losses_compare_with_the_sum_of_real_rewards(loss: Callable[..., Tensor]) -> None:
    rewards = torch.tensor([[1.0, 2.0, 9.0], [1.0, 1.0, 1.0]])
    mask = torch.tensor([[True, True, False], [True, True, True]])
    assert loss(torch.tensor([5.0, 3.0]), rewards, mask).item() == 2.0  # ((5-3)^2 + (3-3)^2) / 2


def test_info_nce_of_two_tasks() -> None:
    queries = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    keys = torch.tensor([[2.0, 0.0], [0.0, 4.0]])
    both = torch.tensor([True, True])
    expected = (math.log(1 + math.exp(-2)) + math.log(1 + math.exp(-4))) / 2
    assert info_nce(queries, keys, both).item() == pytest.approx(expected, rel=1e-6)
    expected = (math.log(1 + math.exp(-1)) + math.log(1 + math.exp(-2))) / 2
    assert info_nce(queries, keys, both, temperature=2.0).item() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("tasks", "temperature", "expected"), [(4, 1.0, 0.743668), (4, 0.1, 1.3619e-4), (16, 1.0, 1.874597)]
)
def test_info_nce_of_orthonormal_contexts_that_match(tasks: int, temperature: float, expected: float) -> None:
    """log(1 + (N - 1) exp(-1 / tau))."""
    contexts, mask = torch.eye(tasks, dtype=torch.float64), torch.ones(tasks, dtype=torch.bool)
    loss = info_nce(contexts, contexts, mask, temperature=temperature)
    assert loss.item() == pytest.approx(expected, rel=1e-4)


def test_info_nce_of_equal_contexts_is_the_log_of_their_number() -> None:
    contexts, mask = torch.ones(16, 3, dtype=torch.float64), torch.ones(16, dtype=torch.bool)
    assert info_nce(contexts, contexts, mask).item() == pytest.approx(2.772589, rel=1e-6)


def test_info_nce_knows_only_present_tasks() -> None:
    queries, keys = random(2, 3, 4).detach(), random(2, 3, 4, seed=1).detach()
    mask = torch.tensor([[True, True, False], [True, False, False]])  # at position 1, task 0 is alone
    pair = info_nce(queries[:1, :2], keys[:1, :2], mask[:1, :2])
    torch.testing.assert_close(info_nce(queries, keys, mask), pair)


def test_task_contrastive_loss_by_hand() -> None:
    """Two tasks, T = 3, K = 2, latent 1, W = 2: at t the prior is c_t and the target c_{t+1}."""
    first, second = [1.0, 2.0, 0.0], [0.0, -1.0, 3.0]
    representations = torch.tensor([first, second]).view(2, 1, 3, 1)
    mask = torch.ones(2, 1, 3, dtype=torch.bool)
    loss = task_contrastive_loss(representations, mask, torch.tensor([[2.0]]), window_length=2)
    terms = []
    for t in range(2):
        for own, prior in enumerate((first[t], second[t])):
            logits = [2.0 * prior * target for target in (first[t + 1], second[t + 1])]
            terms.append(logits[own] - math.log(sum(math.exp(logit) for logit in logits)))
    assert loss.item() == pytest.approx(-sum(terms) / 4, rel=1e-6)


@pytest.mark.parametrize(
    ("order", "expected"),
    [([0, 1, 2], math.log(1 + 2 * math.exp(-4))), ([1, 2, 0], math.log(2 + math.exp(4)))],
    ids=["perfect", "shuffled"],
)
def test_contrastive_loss_of_aligned_and_of_shuffled_tasks(order: list[int], expected: float) -> None:
    """Priors are 2 e_i; targets are the same, or those of the next task: logits 4 for one task, 0 for two."""
    priors = 2.0 * torch.eye(3, dtype=torch.float64)
    representations = torch.stack([priors, priors[order]], dim=1).unsqueeze(1)
    mask, similarity = torch.ones(3, 1, 2, dtype=torch.bool), torch.eye(3, dtype=torch.float64)
    loss = task_contrastive_loss(representations, mask, similarity, window_length=2)
    assert loss.item() == pytest.approx(expected, rel=1e-12)


def test_prior_is_the_mean_of_all_but_the_last_representation() -> None:
    representations = random(2, 1, 3, 4).detach()
    mask = torch.ones(2, 1, 3, dtype=torch.bool)
    similarity = random(4, 4, seed=1).detach()
    loss = task_contrastive_loss(representations, mask, similarity, window_length=3)
    prior = (representations[:, 0, 0] + representations[:, 0, 1]) / 2
    logits = prior @ similarity @ representations[:, 0, 2].T
    torch.testing.assert_close(loss, -torch.log_softmax(logits, dim=-1).diagonal().mean())


def test_contrastive_padding_neither_counts_nor_competes() -> None:
    representations, similarity = random(3, 2, 5, 4).detach(), torch.eye(4, dtype=torch.float64)
    mask = torch.ones(3, 2, 5, dtype=torch.bool)
    mask[2, :, 2:] = False
    loss = task_contrastive_loss(representations, mask, similarity, window_length=2)
    changed = torch.where(mask.unsqueeze(-1), representations, 77.0)
    again = task_contrastive_loss(changed, mask, similarity, window_length=2)
    torch.testing.assert_close(loss, again)
    longer = torch.cat([changed, changed[:, :, :2]], dim=2)
    padded = torch.cat([mask, torch.zeros(3, 2, 2, dtype=torch.bool)], dim=2)
    torch.testing.assert_close(loss, task_contrastive_loss(longer, padded, similarity, window_length=2))


def test_contrastive_loss_of_episodes_shorter_than_a_window_is_zero() -> None:
    mask = torch.ones(2, 1, 3, dtype=torch.bool)
    loss = task_contrastive_loss(random(2, 1, 3, 4), mask, random(4, 4), window_length=5)
    assert loss.item() == 0.0
    loss.backward()  # still part of the graph


def test_distance_metric_by_hand() -> None:
    contexts = torch.tensor([[[0.0, 0.0], [2.0, 0.0]], [[0.0, 4.0], [0.0, 4.0]]])
    loss = distance_metric_loss(contexts, epsilon=0.5)
    expected = (2.0 + 0.0) / 2 + (1 / 8.5 + 1 / 10.5) / 2  # d^2: 4/2 and 0 within; 16/2 and 20/2 between
    assert loss.item() == pytest.approx(expected, rel=1e-6)


def test_distance_metric_of_the_published_code_by_hand() -> None:
    alike = torch.zeros(2, 2, 3)
    loss = distance_metric_loss(alike, attraction="root")
    assert loss.item() == pytest.approx(math.sqrt(1e-3) + 10.0)  # 0.0316228 within a task, 10 between two
    contexts = torch.tensor([[[0.0], [2.0]], [[0.0], [0.0]]])
    between = (1 / 0.1 + 1 / 0.1 + 1 / 4.1 + 1 / 4.1) / 4
    expected = (math.sqrt(4.001) + math.sqrt(1e-3)) / 2 + between
    assert distance_metric_loss(contexts, attraction="root").item() == pytest.approx(expected)


def test_orthogonality_by_hand() -> None:
    weights = torch.tensor([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [1.0, 0.0, 0.0]])
    assert orthogonality_loss(weights).item() == pytest.approx(0.25)  # pairs: 1/4, 1/2, 0
    assert orthogonality_loss(weights[:1]).item() == 0.0


def test_q_loss_by_hand() -> None:
    q_values = torch.tensor([[1.0, 2.0], [0.0, 3.0]])
    loss = q_loss(
        q_values, torch.tensor([1.0, 3.0]), torch.tensor([0.0, 1.0]), torch.tensor([2.0, 100.0]), gamma=0.5
    )
    assert loss.item() == 3.0  # targets 2 and 3: (1 + 1) / 2 + (4 + 0) / 2


def test_targets_get_no_gradient() -> None:
    bootstrap, target = random(3), random(3, seed=1)
    zeros = torch.zeros(3, dtype=torch.float64)
    q_loss(random(2, 3), zeros, zeros, bootstrap, gamma=0.9).backward()
    value_loss(random(3), target).backward()
    assert bootstrap.grad is None
    assert target.grad is None


def test_value_and_policy_loss_by_hand() -> None:
    assert value_loss(torch.tensor([1.0, 3.0]), torch.tensor([2.0, 1.0])).item() == 2.5
    loss = policy_loss(torch.tensor([1.0, 3.0]), torch.tensor([4.0, 2.0]), entropy=0.5)
    assert loss.item() == -2.0  # ((0.5 - 4) + (1.5 - 2)) / 2


def test_cloning_loss_by_hand() -> None:
    acted, actions = torch.tensor([[0.5, 0.0], [1.0, -1.0]]), torch.tensor([[0.0, 0.0], [1.0, 0.5]])
    q_values = torch.tensor([-2.0, 6.0], requires_grad=True)
    loss = cloning_loss(acted.requires_grad_(), actions, q_values)
    assert loss.item() == 2.5  # mean |Q| = 4, squared differences (0.25 + 0 + 0 + 2.25) / 4
    loss.backward()
    assert q_values.grad is None


def test_dual_divergence_is_zero_where_the_estimated_ratio_is_one() -> None:
    one = torch.full((5,), math.log(math.e - 1.0), dtype=torch.float64)  # softplus gives 1
    assert dual_divergence(one, one).tolist() == pytest.approx([0.0] * 5, abs=1e-12)
    two = torch.full((5,), math.log(math.e**2 - 1.0), dtype=torch.float64)
    assert dual_divergence(one, two).tolist() == pytest.approx([math.log(2.0)] * 5)
    zero = torch.zeros(5, dtype=torch.float64)  # 1 - ln 2 + ln ln 2
    assert dual_divergence(zero, zero).tolist() == pytest.approx([-0.0596601] * 5, abs=1e-6)
    assert torch.isfinite(dual_divergence(one, torch.full((5,), -1e4, dtype=torch.float64))).all()


def test_gradient_penalty_starts_above_norm_one() -> None:
    gradients = torch.tensor([[3.0, 4.0], [0.3, 0.4]])
    assert gradient_penalty(gradients).item() == pytest.approx(8.0)  # ((5 - 1)^2 + 0) / 2
