"""TCMRL: a task characteristic extractor trained by reward estimation, and a task contrastive loss.

The paper is "Task characteristic and contrastive contexts for improving generalization in offline
meta-reinforcement learning". Its equations stand below in its order, each with its formula, its number and
our deviations; what several methods use stands in `core/`:

    Eq. 1      c_t = e(s_t, a_t, r_t, s_{t+1})                        core/context.py, ContextEncoder
    Eq. 2      c_mean = mean(c_1, ..., c_T)                           core/networks.py, mean_representation
    Eq. 3-5    w = softmax_t q(c_t, c_mean), c = sum_t w_t c_t        TaskExtractor
    Eq. 6      L_spa = ||(w_1, ..., w_T)||_1                          sparsity_loss
    Eq. 7      L_pos = sum_t (r_hat(s'_t, a'_t, c) - r'_t)^2          positive_reward_loss
    Eq. 8      L_neg = sum_t (r_hat(s'_t, a'_t, c_neg) - r_neg_t)^2   negative_reward_loss, reverse_context
    Eq. 9-10   -log(exp(q_i . k_i) / sum_l exp(q_i . k_l))            core/losses.py, info_nce
    Eq. 11-12  Eq. 10 of m_i^t W and c_l^{t+K-1}, summed over t       task_contrastive_loss
    Eq. 17-18  L_pos and L_neg of the return of a trajectory          positive_, negative_return_loss

Wherever the paper sums over time, the mean over real transitions is taken, so that loss weights mean the same
for short and long episodes. `mask` is True on real transitions and False on padding, which never changes a
value or a gradient. Readings that are not the default stand in `tcmrl_variants.py`.
"""

from collections.abc import Sequence
from typing import ClassVar, Literal, final

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from tcmrl_algo.algorithms import tcmrl_variants as variants
from tcmrl_algo.algorithms.core.context import (
    ContextAlgorithm,
    ContextEncoder,
    ContextLearner,
    ContextLosses,
    EncoderInputs,
    policy_transitions,
)
from tcmrl_algo.algorithms.core.losses import Scalar, distance_metric_loss, info_nce, masked_mean, where_real
from tcmrl_algo.algorithms.core.method import (
    SHARED_SEARCH,
    Algorithm,
    Method,
    MethodConfig,
    Metrics,
    Options,
    Search,
)
from tcmrl_algo.algorithms.core.networks import (
    Attention,
    Perceptron,
    call_frozen,
    mean_representation,
    weighted_sum,
)
from tcmrl_algo.algorithms.core.problem import Problem
from tcmrl_algo.algorithms.core.settings import TrainingSettings
from tcmrl_data import Batch, BatchRequest, Steps, TrainingError, Trajectories, Windows
from tcmrl_data.foundation.records import Frozen

TRIED_WEIGHTS = Options((0.0, 0.01, 0.1, 1.0))
"""Of loss terms, beside a weight of 1 for `positive`."""

ESTIMATOR_WEIGHT = 1.0
"""Of the term `estimator`, the only one that then trains the estimator; Adam is indifferent to its scale."""


class Weights(Frozen):
    """The `[training.tcmrl.weights]` table; a weight of 0 leaves the term out. The paper gives none of them.

    Attributes:
        positive: of Eq. 7 or 17 (ours, by a sweep on the point robot).
        negative: of Eq. 8 or 18 (ours, likewise).
        sparsity: of Eq. 6 (published code: 1e-2 for most environments).
        contrastive: of Eq. 11 (ours: at 1 it saturates the contexts).
        distance: of FOCAL's distance-metric loss (not in the paper; published code: 10, or 100 on ML1,
            where it saturates the contexts).
        orthogonality: of the tasks' attention overlap (not in the paper; published code: 1 or 10).
    """

    positive: float = Field(default=1.0, ge=0)
    negative: float = Field(default=0.1, ge=0)
    sparsity: float = Field(default=0.01, ge=0)
    contrastive: float = Field(default=0.1, ge=0)
    distance: float = Field(default=0.1, ge=0)
    orthogonality: float = Field(default=0.0, ge=0)


class TcmrlConfig(MethodConfig):
    """The `[training.tcmrl]` table. K is `training.batch.window_length`.

    Attributes:
        latent: size of representations and contexts (paper, F.2: 20; 40 for Walker).
        encoder_hidden: widths of the context encoder (published code: 200 x 3).
        tce_hidden: widths of q (paper, F.2: 256); empty for the published code's linear layer.
        estimator_hidden: widths of the reward estimator (paper, F.2: layers of 256, their number not said).
        extractor: `mean` takes the mean of Eq. 2 as the context, in place of Eq. 3-5. Then sparsity,
            orthogonality and L_neg, which shape attention alone, are left out. The paper's variant without
            extractor (Figure 5) has no L_pos either: that is `mean` and a weight of 0 for `positive`.
        reward_estimation: of a `transition` (Eq. 7 and 8) or of a whole `trajectory` (Eq. 17 and 18); `auto`
            goes by the environment's reward density (paper, F.3) and is not searched by `tcmrl tune`: where
            rewards are dense it equals `transition`, and that choice, taken to another environment, would
            undo it. An execution trajectory is one target of a
            `trajectory` and T targets of a `transition`; `batch.execution_trajectories` makes up for it.
        estimator_training: where the weight of `positive` is 0 and L_neg reads the estimator, `always` trains
            the estimator all the same, on detached contexts (published code), and `positive` leaves it at its
            random start (the paper's text: L_pos alone trains it).
        sparsity: of Eq. 6. `sigmoid` is our reading; `centered` takes the mean score off first, so that no
            bias satisfies it (ours); `entropy` is that of the weights (ours); `literal` is the printed form,
            constant and without gradient. `weights.sparsity = 0` leaves it out.
        reverse_scale: `mean` divides c_neg by T - 1 (ours), which brings it close to the mean context;
            `sum` leaves it as printed (see `reverse_context`).
        negative_reward: how targets of L_neg are made wrong (paper, G.3: `random`, r' and noise). On average,
            `random` targets are the true rewards (see `negative_reward_loss`).
        negative_noise: standard deviation of `random`, in standard deviations of the reward
            (published code: 0.5, of the raw reward).
        negative_bias: mean of that noise, likewise (paper and published code: 0). Any other makes `random`
            targets wrong on average: L_neg then teaches c_neg to predict rewards that lie that far off.
        temperature: of the contrastive loss (paper: none, 1).
        distance_examples: execution trajectories that the distance-metric loss takes as further examples of
            their task (ours), so that more of them for Eq. 17 change no other loss.
        weights: of the loss terms.
    """

    latent: int = Field(default=20, ge=1)
    encoder_hidden: tuple[int, ...] = (200, 200, 200)
    tce_hidden: tuple[int, ...] = (256,)
    estimator_hidden: tuple[int, ...] = (256, 256)
    extractor: Literal["attention", "mean"] = "attention"
    reward_estimation: Literal["auto", "transition", "trajectory"] = "auto"
    estimator_training: Literal["always", "positive"] = "always"
    sparsity: Literal["sigmoid", "centered", "entropy", "literal"] = "sigmoid"
    reverse_scale: Literal["mean", "sum"] = "mean"
    negative_reward: Literal["random", "max", "min"] = "random"
    negative_noise: float = Field(default=0.5, ge=0)
    negative_bias: float = 0.0
    temperature: float = Field(default=1.0, gt=0)
    distance_examples: int = Field(default=1, ge=1)
    weights: Weights = Weights()


@final
class TaskExtractor(nn.Module):
    """The task characteristic extractor, Eq. 2-5: scores transitions against their mean and aggregates them.

    Args:
        hidden: widths of q's sigmoid layers (paper, F.2: 256); empty makes q linear, as in the code.
    """

    def __init__(self, latent: int, *, hidden: Sequence[int], generator: torch.Generator) -> None:
        super().__init__()
        self.perceptron = Perceptron((2 * latent, *hidden, 1), generator=generator, activation=torch.sigmoid_)

    def forward(
        self, representations: Float[Tensor, "lanes steps latent"], mask: Bool[Tensor, "lanes steps"]
    ) -> Attention:
        """Attention over each lane's real transitions, of which there must be at least one.

        c_mean = mean(c_1, ..., c_T); score_t = q(c_t, c_mean); w = softmax(score); c = sum_t w_t c_t.
        """
        mean = mean_representation(representations, mask).unsqueeze(1)
        inputs = torch.cat([representations, mean.expand_as(representations)], dim=-1)
        scores = self.perceptron(inputs).squeeze(-1)
        weights = torch.softmax(where_real(mask, scores, -torch.inf), dim=-1)
        context = weighted_sum(weights, where_real(mask.unsqueeze(-1), representations, 0.0))
        return Attention(representations, scores, weights, context, mask)


def sparsity_loss(scores: Float[Tensor, "lanes steps"], mask: Bool[Tensor, "lanes steps"]) -> Scalar:
    """Our reading of Eq. 6: mean over transitions of sigmoid(score).

    Deviation: the printed form is constant (see `literal_sparsity_loss`). Scores before the softmax are
    free to fall for all but the telling transitions. They may also fall for all transitions together, which
    lowers this loss and changes no weight; other readings in `tcmrl_variants.py` rule that out.
    """
    return masked_mean(torch.sigmoid(scores), mask)


@final
class RewardEstimator(nn.Module):
    """r_hat(s, a, c), the reward of a transition, or r_hat(s_1, a_1, ..., c), the return of a trajectory.

    Args:
        inputs: width of what is estimated on: a transition's state and action (Eq. 7 and 8), or those of a
            whole trajectory `side_by_side` (Eq. 17 and 18).
    """

    def __init__(
        self, inputs: int, *, latent: int, hidden: Sequence[int], generator: torch.Generator
    ) -> None:
        super().__init__()
        self.perceptron = Perceptron((inputs + latent, *hidden, 1), generator=generator)

    def forward(
        self, inputs: Float[Tensor, "tasks rows inputs"], context: Float[Tensor, "tasks latent"]
    ) -> Float[Tensor, "tasks rows"]:
        """One estimate per row, under its task's context."""
        spread = context.unsqueeze(1).expand(-1, inputs.shape[1], -1)
        values: Tensor = self.perceptron(torch.cat([inputs, spread], dim=-1))
        return values.squeeze(-1)


def side_by_side(
    steps: Float[Tensor, "tasks trajectories steps inputs"],
    mask: Bool[Tensor, "tasks trajectories steps"],
    *,
    horizon: int,
) -> Float[Tensor, "tasks trajectories all_inputs"]:
    """The steps of a trajectory as one vector; steps that an episode does not have are zeros."""
    real = where_real(mask.unsqueeze(-1), steps, 0.0)
    return functional.pad(real, (0, 0, 0, horizon - steps.shape[2])).flatten(2)


def positive_reward_loss(
    predicted: Float[Tensor, "*lanes steps"],
    rewards: Float[Tensor, "*lanes steps"],
    mask: Bool[Tensor, "*lanes steps"],
) -> Scalar:
    """Eq. 7: L_pos = sum_t (r_hat(s'_t, a'_t, c) - r'_t)^2, as a mean over real steps."""
    return masked_mean((predicted - rewards) ** 2, mask)


def reverse_context(
    representations: Float[Tensor, "lanes steps latent"],
    weights: Float[Tensor, "lanes steps"],
    mask: Bool[Tensor, "lanes steps"],
    *,
    literal: bool = False,
) -> Float[Tensor, "lanes latent"]:
    """The context of what attention neglects: c_neg = sum_t (1 - w_t) c_t / (T - 1) (text above Eq. 8).

    With the mean representation c_mean (Eq. 2) and the context c = sum_t w_t c_t (Eq. 5),
    c_neg = (T c_mean - c) / (T - 1) = c_mean + (c_mean - c) / (T - 1): nearly the mean context for all but
    the shortest lanes, whatever the attention is. Undivided, it points the same way and is T - 1 times
    as long, which is outside of what the reward estimator sees of contexts in L_pos.

    Args:
        weights: attention weights w_t, which sum to 1 over each lane's real steps.
        literal: leave the sum undivided, as printed. Its weights sum to T - 1, so its scale grows with T.
    """
    reverse = where_real(mask, 1.0 - weights, 0.0)
    if not literal:
        reverse = reverse / (mask.sum(dim=-1, keepdim=True) - 1).clamp(min=1)
    return weighted_sum(reverse, representations)


def negative_reward_loss(
    predicted: Float[Tensor, "*lanes steps"],
    negative: Float[Tensor, "*lanes steps"],
    mask: Bool[Tensor, "*lanes steps"],
) -> Scalar:
    """Eq. 8: L_neg = sum_t (r_hat(s'_t, a'_t, c_neg) - r_neg_t)^2, as a mean over real steps.

    `predicted` must come from an estimator whose parameters are held fixed: the paper keeps L_neg from
    training it (`call_frozen` does that).

    With r_neg = r' + e and noise e of mean zero and variance v that is independent of r_hat,
    E (r_hat - r' - e)^2 = (r_hat - r')^2 + v: the expected loss is that of the true reward plus a constant,
    and so the expected gradient trains c_neg, too, to predict the true reward. The noise adds variance alone.
    With noise of mean b the expected gradient is that of fitting r' + b.
    """
    return masked_mean((predicted - negative) ** 2, mask)


def task_contrastive_loss(
    representations: Float[Tensor, "tasks trajectories steps latent"],
    mask: Bool[Tensor, "tasks trajectories steps"],
    similarity: Float[Tensor, "latent latent"],
    *,
    window_length: int,
    temperature: float = 1.0,
) -> Scalar:
    """Eq. 11-12: L_TCL = -1/(T-K+1) 1/B sum_t sum_i log softmax_l(m_i^t W c_l^{t+K-1})[i].

    m^t is the mean of the K - 1 representations before the window's last one. Deviations: the printed
    log(a / sum a) is undefined for negative a, so Eq. 10's exponentials stand in; and a query keeps its own
    m_i in the denominator, as in Eq. 10, where Eq. 11 prints m_l. Of tasks that end early, position t knows
    only those with a whole window there.

    Args:
        representations: c_t of the n-th trajectory of every task; windows at equal (n, t) are compared.
        mask: real steps, padding at the end.
        window_length: K > 1. Trajectories shorter than K have no window.
        temperature: divides the logits (not in the paper's Eq. 11; 1 there).
    """
    if representations.shape[2] < window_length:
        return (representations * 0.0).sum() + (similarity * 0.0).sum()
    last = window_length - 1
    priors = representations[:, :, :-1].flatten(0, 1)  # every step but the last begins a prior
    if last > 1:
        priors = functional.avg_pool1d(priors.transpose(1, 2), last, stride=1).transpose(1, 2)
    return info_nce(
        (priors @ similarity).unflatten(0, representations.shape[:2]).permute(1, 2, 0, 3),
        representations[:, :, last:].permute(1, 2, 0, 3),
        mask[:, :, last:].permute(1, 2, 0),  # padding is at the end: the last step being real suffices
        temperature=temperature,
    )


def positive_return_loss(
    predicted: Float[Tensor, "*lanes"],
    rewards: Float[Tensor, "*lanes steps"],
    mask: Bool[Tensor, "*lanes steps"],
) -> Scalar:
    """Eq. 17 (sparse rewards): L_pos = (r_hat(s'_1, a'_1, ..., s'_T, a'_T, c) - sum_t r'_t)^2, lane mean."""
    return ((predicted - where_real(mask, rewards, 0.0).sum(dim=-1)) ** 2).mean()


def negative_return_loss(
    predicted: Float[Tensor, "*lanes"],
    negative: Float[Tensor, "*lanes steps"],
    mask: Bool[Tensor, "*lanes steps"],
) -> Scalar:
    """Eq. 18 (sparse rewards): L_neg = (r_hat(..., c_neg) - sum_t r_neg_t)^2, lane mean.

    As for Eq. 8, the estimator behind `predicted` must be held fixed.
    """
    return ((predicted - where_real(mask, negative, 0.0).sum(dim=-1)) ** 2).mean()


@final
class TcmrlLearner(ContextLearner):
    """Encoder, extractor, reward estimator and W, and the losses that train them."""

    def __init__(self, problem: Problem, settings: TrainingSettings, config: TcmrlConfig) -> None:
        super().__init__()
        self.latent, self.config = config.latent, config
        self._horizon, self._window_length = problem.horizon, settings.batch.window_length
        if config.weights.contrastive and self._window_length > self._horizon:
            raise TrainingError(
                f"batch.window_length {self._window_length} is longer than an episode, "
                f"{self._horizon} steps, so that the contrastive loss has no window; choose a shorter one, "
                "or tcmrl.weights.contrastive = 0"
            )
        self.estimates_trajectories = config.reward_estimation == "trajectory" or (
            config.reward_estimation == "auto" and problem.reward_density == "sparse"
        )
        generator = problem.generator(0)
        self.encoder = ContextEncoder(
            problem, latent=config.latent, hidden=config.encoder_hidden, generator=generator
        )
        # Drawn even where the mean replaces it: what comes after starts the same with and without it.
        self.extractor = TaskExtractor(config.latent, hidden=config.tce_hidden, generator=generator)
        width = self.encoder.state_action * (problem.horizon if self.estimates_trajectories else 1)
        self.estimator = RewardEstimator(
            width, latent=config.latent, hidden=config.estimator_hidden, generator=generator
        )
        self.similarity = nn.Parameter(torch.eye(config.latent))

    def context(self, steps: Steps) -> Float[Tensor, "lanes latent"]:
        return self.attention(steps).context

    def attention(self, steps: Steps) -> Attention:
        (representations,) = self.encoder(self.encoder.read(steps))
        return self._attend(representations.flatten(1, 2), steps.mask.flatten(1, 2))

    def losses(self, batch: Batch, step: int, generator: torch.Generator) -> ContextLosses:
        """The weighted terms; those of weight 0 are not computed.

        Contexts come from the context trajectories alone; the execution trajectories are what rewards
        are estimated on, and the first of them further examples of every task for the distance-metric loss.
        Without drawn windows, the contrastive loss takes all windows of the context trajectories.
        """
        weights, encoder = self.config.weights, self.encoder
        context, execution = encoder.read(batch["context"]), encoder.read(batch["execution"])
        windows = encoder.read(batch["windows"]) if "windows" in batch else context
        examples = execution.first(self.config.distance_examples)
        groups = [context]
        groups += [examples] if weights.distance else []
        groups += [windows] if weights.contrastive and windows is not context else []
        representations = encoder(*groups)
        attention = self._attend(representations[0].flatten(1, 2), context.mask.flatten(1, 2))
        terms = self._reward_losses(attention, execution, generator)
        terms |= self._attention_losses(attention)
        if weights.contrastive:
            last = representations[-1] if windows is not context else representations[0]
            terms["contrastive"] = task_contrastive_loss(
                last,
                windows.mask,
                self.similarity,
                window_length=self._window_length,
                temperature=self.config.temperature,
            )
        if weights.distance:
            mask = torch.cat([context.mask, examples.mask], dim=1)
            single = torch.cat(representations[:2], dim=1).flatten(0, 1)  # one context per trajectory
            contexts = self._attend(single, mask.flatten(0, 1)).context
            terms["distance"] = distance_metric_loss(contexts.unflatten(0, mask.shape[:2]))
        total = attention.context.new_zeros(())
        for name, term in terms.items():
            total = total + getattr(weights, name, ESTIMATOR_WEIGHT) * term
        metrics = {f"loss/{name}": term for name, term in terms.items()}
        metrics["context/largest_weight"] = attention.weights.amax(dim=-1).mean()
        metrics["context/spread"] = attention.context.std(dim=0).mean()
        return ContextLosses(total, attention.context, metrics)

    def _attend(
        self, representations: Float[Tensor, "lanes steps latent"], mask: Bool[Tensor, "lanes steps"]
    ) -> Attention:
        """Eq. 2-5, one softmax over all transitions of a lane, or their mean."""
        if self.config.extractor == "mean":
            return variants.uniform_attention(representations, mask)
        result: Attention = self.extractor(representations, mask)
        return result

    def _reward_losses(
        self, attention: Attention, execution: EncoderInputs, generator: torch.Generator
    ) -> Metrics:
        """Eq. 7 and 8, or 17 and 18; rewards in standard deviations, and returns divided by the horizon.

        L_neg sees the estimator with its parameters held fixed (paper, end of section 4.1.1). Without
        L_pos, the term `estimator` trains the estimator alone, for L_neg to read.
        """
        config, weights = self.config, self.config.weights
        whole, mask = self.estimates_trajectories, execution.mask
        shape = mask.shape[:2] if whole else mask.shape
        rewards = execution.rewards / (self._horizon if whole else 1)
        if whole:
            inputs = side_by_side(execution.state_actions, mask, horizon=self._horizon)
        else:
            inputs = execution.state_actions.flatten(1, 2)
        terms: Metrics = {}
        has_negative = weights.negative > 0 and config.extractor == "attention"
        positive = positive_return_loss if whole else positive_reward_loss
        if weights.positive:
            predicted = self.estimator(inputs, attention.context)
            terms["positive"] = positive(predicted.view(shape), rewards, mask)
        elif has_negative and config.estimator_training == "always":
            predicted = self.estimator(inputs, attention.context.detach())
            terms["estimator"] = positive(predicted.view(shape), rewards, mask)
        if has_negative:
            unit = self._horizon if whole else 1
            draws = torch.randn(rewards.shape, generator=generator).to(rewards.device)
            noise = config.negative_noise / unit * draws + config.negative_bias / unit
            wrong = rewards + noise
            if config.negative_reward != "random":
                wrong = variants.extreme_rewards(rewards, mask, kind=config.negative_reward)
            reverse = reverse_context(
                attention.representations,
                attention.weights,
                attention.mask,
                literal=config.reverse_scale == "sum",
            )
            misled = call_frozen(self.estimator, inputs, reverse)
            negative = negative_return_loss if whole else negative_reward_loss
            terms["negative"] = negative(misled.view(shape), wrong, mask)
        return terms

    def _attention_losses(self, attention: Attention) -> Metrics:
        """Eq. 6, and the published code's orthogonality."""
        config, terms = self.config, {}
        if config.extractor == "mean":
            return {}
        if config.weights.sparsity:
            reading = sparsity_loss if config.sparsity == "sigmoid" else variants.SPARSITY[config.sparsity]
            read = attention.weights if config.sparsity == "literal" else attention.scores
            terms["sparsity"] = reading(read, attention.mask)
        if config.weights.orthogonality:
            terms["orthogonality"] = variants.orthogonality_loss(attention.weights)
        return terms


@final
class Tcmrl(Method[TcmrlConfig]):
    """The plug-in."""

    name = "tcmrl"
    Config = TcmrlConfig
    search: ClassVar[Search] = {
        **SHARED_SEARCH,
        "tcmrl.weights.negative": TRIED_WEIGHTS,
        "tcmrl.weights.sparsity": TRIED_WEIGHTS,
        "tcmrl.weights.contrastive": TRIED_WEIGHTS,
        "tcmrl.weights.distance": TRIED_WEIGHTS,
    }

    def batch_request(self, settings: TrainingSettings, config: TcmrlConfig) -> BatchRequest:
        """The `[training.batch]` table as it is."""
        batch = settings.batch
        return BatchRequest(
            batch.tasks,
            {
                "policy": policy_transitions(settings),
                "context": Trajectories(batch.context_trajectories),
                "execution": Trajectories(batch.execution_trajectories, apart_from="context"),
                "windows": Windows(batch.windows, batch.window_length),
            },
        )

    def create(self, problem: Problem, settings: TrainingSettings, config: TcmrlConfig) -> Algorithm:
        return ContextAlgorithm(problem, settings, learner=TcmrlLearner(problem, settings, config))
