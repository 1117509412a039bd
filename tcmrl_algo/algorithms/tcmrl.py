"""TCMRL: a task characteristic extractor trained by reward estimation, and a task contrastive loss."""

from typing import ClassVar, Literal, final

import torch
from jaxtyping import Bool, Float
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from tcmrl_algo.context_methods.encoding import ContextEncoder, EncoderInputs
from tcmrl_algo.context_methods.learner import ContextAlgorithm, ContextLearner, ContextLosses
from tcmrl_algo.context_methods.requests import policy_transitions
from tcmrl_algo.losses import context as losses
from tcmrl_algo.methods.base import Algorithm, Method, MethodConfig, Metrics
from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.methods.search import SHARED_SEARCH, Options, Search
from tcmrl_algo.networks.attention import Attention, TaskExtractor, uniform_attention
from tcmrl_algo.networks.perceptron import call_frozen
from tcmrl_algo.networks.reward_estimator import RewardEstimator, side_by_side
from tcmrl_algo.settings.training import TrainingSettings
from tcmrl_data import Batch, BatchRequest, Steps, Trajectories, Windows

SPARSITY = {
    "sigmoid": losses.sparsity_loss,
    "centered": losses.centered_sparsity_loss,
    "entropy": losses.entropy_sparsity_loss,
}
"""Readings of Eq. 6 that are functions of the scores."""

TRIED_WEIGHTS = Options((0.0, 0.01, 0.1, 1.0))
"""Of loss terms, beside a weight of 1 for `positive`."""

ESTIMATOR_WEIGHT = 1.0
"""Of the term `estimator`, the only one that then trains the estimator; Adam is indifferent to its scale."""


class Weights(BaseModel):
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

    model_config = ConfigDict(frozen=True, extra="forbid")

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
            `sum` leaves it as printed (see `losses.context.reverse_context`).
        negative_reward: how targets of L_neg are made wrong (paper, G.3: `random`). On average, `random`
            targets are the true rewards (see `losses.context.negative_reward_loss`).
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
    negative_reward: losses.NegativeKind = "random"
    negative_noise: float = Field(default=0.5, ge=0)
    negative_bias: float = 0.0
    temperature: float = Field(default=1.0, gt=0)
    distance_examples: int = Field(default=1, ge=1)
    weights: Weights = Weights()


@final
class TcmrlLearner(ContextLearner):
    """Encoder, extractor, reward estimator and W, and the losses that train them."""

    def __init__(self, problem: Problem, settings: TrainingSettings, config: TcmrlConfig) -> None:
        super().__init__()
        self.latent, self.config = config.latent, config
        self._horizon, self._window_length = problem.horizon, settings.batch.window_length
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
            terms["contrastive"] = self._contrastive_loss(last, windows.mask)
        if weights.distance:
            mask = torch.cat([context.mask, examples.mask], dim=1)
            terms["distance"] = self._distance_loss(torch.cat(representations[:2], dim=1), mask)
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
            return uniform_attention(representations, mask)
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
        positive = losses.positive_return_loss if whole else losses.positive_reward_loss
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
            wrong = losses.negative_rewards(rewards, mask, kind=config.negative_reward, noise=noise)
            reverse = losses.reverse_context(
                attention.representations,
                attention.weights,
                attention.mask,
                literal=config.reverse_scale == "sum",
            )
            misled = call_frozen(self.estimator, inputs, reverse)
            negative = losses.negative_return_loss if whole else losses.negative_reward_loss
            terms["negative"] = negative(misled.view(shape), wrong, mask)
        return terms

    def _attention_losses(self, attention: Attention) -> Metrics:
        """Eq. 6, and the published code's orthogonality."""
        weights, terms = self.config.weights, {}
        if self.config.extractor == "mean":
            return {}
        if weights.sparsity:
            if self.config.sparsity == "literal":
                terms["sparsity"] = losses.literal_sparsity_loss(attention.weights, attention.mask)
            else:
                terms["sparsity"] = SPARSITY[self.config.sparsity](attention.scores, attention.mask)
        if weights.orthogonality:
            terms["orthogonality"] = losses.orthogonality_loss(attention.weights)
        return terms

    def _contrastive_loss(self, representations: Tensor, mask: Tensor) -> Tensor:
        return losses.task_contrastive_loss(
            representations,
            mask,
            self.similarity,
            window_length=self._window_length,
            temperature=self.config.temperature,
        )

    def _distance_loss(self, representations: Tensor, mask: Tensor) -> Tensor:
        """FOCAL's loss over the contexts of single trajectories."""
        contexts = self._attend(representations.flatten(0, 1), mask.flatten(0, 1)).context
        return losses.distance_metric_loss(contexts.unflatten(0, mask.shape[:2]))


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
