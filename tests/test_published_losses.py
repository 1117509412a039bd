"""The losses of the published codes of FOCAL and TCMRL on five fixed batches, beside ours.

The numbers come from one training step of the published code, in double precision: of FOCAL,
FOCAL-ICLR/FOCAL-ICLR at cc2f1fd (class FOCALSoftActorCritic), and of TCMRL, hehongc/TCMRL at 288a4b9 (class
CPEARL). Its networks were replaced by ones that return the arrays of `published_batch`; the layer that scores
transitions, the agent and all losses are its own. BRAC and the entropy bonus are on, gamma is 0.99, rewards
are scaled by 5, the distance loss weighs 10, means and log standard deviations 0.001. The two codes share the
losses of the actor-critic.

Every test says how our loss differs from the published one, and holds to 1e-5 once that is accounted for.
"""

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from tcmrl_algo.algorithms.core.actor_critic.sac import (
    DualCritic,
    dual_divergence,
    gradient_penalty,
    policy_loss,
    value_loss,
)
from tcmrl_algo.algorithms.core.losses import distance_metric_loss, info_nce, q_loss
from tcmrl_algo.algorithms.core.networks import Attention, mean_representation
from tcmrl_algo.algorithms.core.settings import BracSettings
from tcmrl_algo.algorithms.tcmrl import (
    TaskExtractor,
    negative_reward_loss,
    positive_reward_loss,
    reverse_context,
    sparsity_loss,
    task_contrastive_loss,
)
from tcmrl_algo.algorithms.tcmrl_variants import orthogonality_loss
from tests.published_batches import BATCHES, LATENT, PublishedBatch, published_batch

DISTANCE_WEIGHT = 10.0
GAMMA, REWARD_SCALE, REGULARIZATION = 0.99, 5.0, 1e-3

ACTOR_CRITIC: dict[str, list[float]] = {
    "divergence": [-0.21386935, 0.00150944, 0.0360647, -0.43530359, -0.20072874],
    "dual": [0.79813914, 0.16216236, 0.55981659, 0.7372334, 1.12350966],
    "q": [41.82693302, 98.6667138, 145.93741651, 539.49377234, 305.18794904],
    "value": [3.72942981, 2.71908219, 3.08709668, 3.99664153, 3.75690932],
    "policy": [0.74095767, 0.68718121, 0.75401596, -6.27934775, -3.34764005],
    "alpha": [-0.26386935, 4.95150944, 9.9860647, 14.51469641, 19.74927126],
}
FOCAL_DISTANCE = [52.09798576, 58.05203298, 41.730271, 61.47551217, 44.62775461]
TCMRL: dict[str, list[float]] = {
    "context": [0.17715308, 0.15279561, 0.16727735, 0.12851302, 0.16057992],  # the mean of its squares
    "reverse": [1.52961425, 1.82158474, 1.82343341, 0.88655225, 2.16634612],  # likewise
    "distance": [38.01664854, 48.50102032, 32.56314184, 43.20837107, 35.39139986],
    "orthogonality": [0.06747516, 0.05457816, 0.06248411, 0.0557465, 0.06023152],
    "sparsity": [19.58208318, 14.20530029, 8.61457792, 13.00990285, 10.4997495],
    "positive": [0.02577901, 0.02815147, 0.02461357, 0.04118392, 1.2051324],
    "estimator": [0.05155801, 0.05630294, 0.04922715, 0.08236784, 3.54262573],
    "negative": [0.06926799, 0.07768936, 0.07973304, 0.06007461, 1.04613799],
    "contrastive": [1.93417907, 1.62642775, 1.37776782, 1.61135491, 2.07223009],
}

every = pytest.mark.parametrize("index", range(BATCHES))


def close(ours: Tensor | float, published: float) -> None:
    torch.testing.assert_close(
        torch.as_tensor(ours, dtype=torch.float64), torch.tensor(published).double(), rtol=1e-5, atol=1e-5
    )


def tensor(values: np.typing.NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(values)


def rows(batch: PublishedBatch) -> dict[str, Tensor]:
    return {name: tensor(values) for name, values in batch.rows.items()}


def everywhere(batch: PublishedBatch) -> Tensor:
    return torch.ones(batch.representations.shape[:2], dtype=torch.bool)


def attention_of(batch: PublishedBatch) -> Attention:
    """Ours with q as the published linear layer."""
    extractor = TaskExtractor(LATENT, hidden=(), generator=torch.Generator()).double()
    layer = extractor.perceptron.layers[-1]
    assert isinstance(layer, torch.nn.Linear)
    with torch.no_grad():
        layer.weight.copy_(tensor(batch.score_weights).unsqueeze(0))
        layer.bias.fill_(batch.score_bias)
    found: Attention = extractor(tensor(batch.representations), everywhere(batch))
    return found


def published_distance(batch: PublishedBatch, contexts: Tensor) -> float:
    """From ours: its two means are divided by the number of pairs, the published sums by that plus 0.001.

    The published code takes every pair once and ours twice, which changes no mean. In a meta-batch without
    repetition, FOCAL's default, there is no pair of one task: nothing attracts.
    """
    numbers = np.array(batch.tasks)
    same = int(sum((numbers[:place] == number).sum() for place, number in enumerate(numbers)))
    other = len(numbers) * (len(numbers) - 1) // 2 - same
    by_task = torch.stack([contexts[numbers == task] for task in np.unique(numbers)])
    together = distance_metric_loss(by_task, epsilon=0.1, attraction="root").item()
    attraction = distance_metric_loss(by_task, epsilon=1e30, attraction="root").item()
    repulsion = together - attraction
    assert (attraction > 1e-6) is (same > 0)
    return DISTANCE_WEIGHT * (attraction * same / (same + 1e-3) + repulsion * other / (other + 1e-3))


@every
def test_the_distances_of_focal_differ_by_the_thousandth_in_their_denominators(index: int) -> None:
    batch = published_batch(index)
    contexts = mean_representation(tensor(batch.representations), everywhere(batch))
    close(published_distance(batch, contexts), FOCAL_DISTANCE[index])


@every
def test_contexts_are_those_of_the_published_attention(index: int) -> None:
    """Likewise c_neg, whose weights the published code does not divide by T - 1; and so the distances."""
    batch = published_batch(index)
    attention = attention_of(batch)
    close(attention.context.square().mean(), TCMRL["context"][index])
    reverse = reverse_context(attention.representations, attention.weights, attention.mask, literal=True)
    close(reverse.square().mean(), TCMRL["reverse"][index])
    close(published_distance(batch, attention.context.detach()), TCMRL["distance"][index])


@every
def test_sparsity_is_the_published_sum_as_a_mean(index: int) -> None:
    """Of sigmoid(score), over all transitions of all tasks."""
    attention = attention_of(published_batch(index))
    ours = sparsity_loss(attention.scores, attention.mask)
    close(ours * attention.scores.numel(), TCMRL["sparsity"][index])


@every
def test_orthogonality_is_a_mean_over_pairs_where_the_published_one_counts_all_entries(index: int) -> None:
    """Of the matrix of overlaps it zeroes all but one triangle, and then takes the mean of all entries."""
    attention = attention_of(published_batch(index))
    tasks = len(attention.weights)
    ours = orthogonality_loss(attention.weights)
    close(ours * (tasks - 1) / (2 * tasks), TCMRL["orthogonality"][index])


def smooth(errors: Tensor) -> Tensor:
    """What smooth L1 takes off half the square where an error exceeds 1: (|e| - 1)^2 / 2."""
    return 0.5 * functional.relu(errors.abs() - 1.0).square()


@every
def test_reward_losses_are_squares_where_the_published_ones_are_smooth(index: int) -> None:
    """Smooth L1 is half the square of an error up to 1, and linear beyond, as it is in the last batch.

    The published code trains its estimator besides by a squared error on detached contexts, which is ours.
    """
    batch, mask = published_batch(index), everywhere(published_batch(index))
    rewards = tensor(batch.rows["reward"]).view(mask.shape)
    good, bad = (tensor(values) for values in batch.predicted)
    ours = positive_reward_loss(good, rewards, mask)
    close(ours, TCMRL["estimator"][index])
    close(ours / 2 - smooth(good - rewards).mean(), TCMRL["positive"][index])
    wrong = rewards + tensor(batch.noise)
    ours = negative_reward_loss(bad, wrong, mask)
    close(ours / 2 - smooth(bad - wrong).mean(), TCMRL["negative"][index])
    assert bool(smooth(good - rewards).any()) is (index == 4)


@every
def test_the_contrastive_loss_takes_its_softmax_over_the_other_side(index: int) -> None:
    """Published: over the tasks' means m_l for every c_i; Eq. 10 and 11, and ours: over c_l for every m_i.

    The logits are the same numbers, transposed, if W is: c_i W m_l. Windows have four steps; at every
    position all tasks have one.
    """
    batch = published_batch(index)
    representations, weights = tensor(batch.representations), tensor(batch.similarity)
    windows = representations.unfold(1, 4, 1).permute(1, 0, 3, 2)  # (positions, tasks, K, latent)
    means, last = windows[:, :, :-1].mean(dim=2), windows[:, :, -1]
    mask = torch.ones(last.shape[:2], dtype=torch.bool)
    close(info_nce(last @ weights, means, mask), TCMRL["contrastive"][index])
    ours = task_contrastive_loss(
        representations.unsqueeze(1), everywhere(batch).unsqueeze(1), weights.T, window_length=4
    )
    torch.testing.assert_close(ours, info_nce(means @ weights.T, last, mask))
    torch.testing.assert_close((last @ weights) @ means.mT, ((means @ weights.T) @ last.mT).mT)


def divergences_of(values: dict[str, Tensor]) -> Tensor:
    return dual_divergence(values["dual_behavior"], values["dual_policy"])


@every
def test_the_divergence_is_the_published_one(index: int) -> None:
    """But for 1e-8 within its logarithm."""
    values = rows(published_batch(index))
    close(divergences_of(values).mean(), ACTOR_CRITIC["divergence"][index])


@every
def test_the_dual_critic_is_penalised_by_its_gradient_where_the_published_one_is_by_its_output(
    index: int,
) -> None:
    """With the critic's output between the actions in the gradient's place, the numbers agree."""
    values = rows(published_batch(index))
    penalty = gradient_penalty(values["dual_between"].unsqueeze(-1))
    close(5.0 * penalty - divergences_of(values).mean(), ACTOR_CRITIC["dual"][index])


@every
def test_q_follows_the_published_targets(index: int) -> None:
    """Which take alpha D(s) off V(s'); our `value` mode takes it off V's target at s, which is not this."""
    batch = published_batch(index)
    values = rows(batch)
    ours = q_loss(
        torch.stack([values["q1"], values["q2"]]),
        REWARD_SCALE * values["reward"],
        values["terminated"],
        values["target_v"] - batch.alpha * divergences_of(values),
        gamma=GAMMA,
    )
    close(ours, ACTOR_CRITIC["q"][index])


@every
def test_v_and_the_policy_follow_the_published_losses(index: int) -> None:
    batch = published_batch(index)
    values = rows(batch)
    acted = torch.minimum(values["acted_q1"], values["acted_q2"])
    close(value_loss(values["v"], acted - values["log_probability"]), ACTOR_CRITIC["value"][index])
    policy = policy_loss(values["log_probability"], acted, entropy=1.0)
    squares = sum(values[name].square().mean() for name in ("mean", "log_std"))
    penalty = batch.alpha * divergences_of(values).mean() + REGULARIZATION * squares
    close(policy + penalty, ACTOR_CRITIC["policy"][index])


@every
def test_alpha_takes_the_published_step_and_is_clipped_where_it_is_kept(index: int) -> None:
    """The published code clips alpha only where it is used."""
    batch = published_batch(index)
    settings = BracSettings(mode="policy", alpha=batch.alpha)
    critic = DualCritic(settings, (2, 4), generator=torch.Generator())
    critic.last_divergence.copy_(divergences_of(rows(batch)).mean())
    critic.adapt_alpha()
    close(critic.alpha, max(ACTOR_CRITIC["alpha"][index], 0.0))


def test_without_a_learning_rate_alpha_stays_where_it_started() -> None:
    settings = BracSettings(mode="policy", alpha=3.0, alpha_learning_rate=0.0)
    critic = DualCritic(settings, (2, 4), generator=torch.Generator())
    critic.last_divergence.fill_(1e3)
    critic.adapt_alpha()
    assert critic.alpha.item() == 3.0
