"""TCMRL: a task characteristic extractor trained by reward estimation, and a task contrastive loss."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal, final

import torch
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from tcmrl_algo import losses
from tcmrl_algo.actor_critic import ActorCritic
from tcmrl_algo.config import TrainingSettings
from tcmrl_algo.context_algorithm import ContextAlgorithm, pack
from tcmrl_algo.networks import (
    Attention,
    ContextEncoder,
    Standardizer,
    TaskExtractor,
    TrajectoryRewardEstimator,
    TransitionRewardEstimator,
    call_frozen,
)
from tcmrl_algo.problem import Algorithm, Metrics, Problem, TrainedModules
from tcmrl_data import Batch, BatchSizes, Steps, Trajectory

NAME = "tcmrl"


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


class Config(BaseModel):
    """The `[training.tcmrl]` table. K is `training.batch.window_length`.

    Attributes:
        latent: size of representations and contexts (paper, F.2: 20; 40 for Walker).
        encoder_hidden: widths of the context encoder (published code: 200 x 3).
        tce_hidden: widths of q (paper, F.2: 256); empty for the published code's linear layer.
        estimator_hidden: widths of the reward estimator (paper, F.2: layers of 256, their number not said).
        sparsity: `sigmoid` is our reading of Eq. 6; `literal` prints it, constant and without gradient.
        reverse_scale: `mean` divides c_neg by T - 1 (ours), `sum` leaves it as printed.
        negative_reward: how targets of L_neg are made wrong (paper, G.3: `random`).
        negative_noise: standard deviation of `random`, in standard deviations of the reward
            (published code: 0.5, of the raw reward).
        temperature: of the contrastive loss (paper: none, 1).
        weights: of the loss terms.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    latent: int = Field(default=20, ge=1)
    encoder_hidden: tuple[int, ...] = (200, 200, 200)
    tce_hidden: tuple[int, ...] = (256,)
    estimator_hidden: tuple[int, ...] = (256, 256)
    sparsity: Literal["sigmoid", "literal"] = "sigmoid"
    reverse_scale: Literal["mean", "sum"] = "mean"
    negative_reward: losses.NegativeKind = "random"
    negative_noise: float = Field(default=0.5, ge=0)
    temperature: float = Field(default=1.0, gt=0)
    weights: Weights = Weights()


def batch_sizes(settings: TrainingSettings) -> BatchSizes:
    """The `[training.batch]` table as it is."""
    return settings.batch


def create(problem: Problem, settings: TrainingSettings, config: Config) -> Algorithm:
    """A new learner, its networks at their start."""
    return Tcmrl(problem, settings, config)


@final
class ContextLearner(nn.Module):
    """Encoder, extractor, reward estimator and W: everything that the context losses train."""

    def __init__(self, problem: Problem, config: Config, *, generator: torch.Generator) -> None:
        super().__init__()
        sizes = (problem.observation_dim, problem.action_dim)
        latent, hidden = config.latent, config.estimator_hidden
        self.observations = Standardizer(problem.observation_mean, problem.observation_std)
        self.changes = Standardizer(problem.change_mean, problem.change_std)
        self.actions = Standardizer(problem.action_mean, problem.action_std)
        self.rewards = Standardizer(torch.tensor([problem.reward_mean]), torch.tensor([problem.reward_std]))
        self.encoder = ContextEncoder(
            *sizes, latent=latent, hidden=config.encoder_hidden, generator=generator
        )
        self.extractor = TaskExtractor(latent, hidden=config.tce_hidden, generator=generator)
        self.estimator: TransitionRewardEstimator | TrajectoryRewardEstimator
        if problem.reward_density == "sparse":
            self.estimator = TrajectoryRewardEstimator(
                *sizes, latent=latent, horizon=problem.horizon, hidden=hidden, generator=generator
            )
        else:
            self.estimator = TransitionRewardEstimator(
                *sizes, latent=latent, hidden=hidden, generator=generator
            )
        self.similarity = nn.Parameter(torch.eye(latent))

    def standardized(self, steps: Steps) -> Steps:
        """Steps in units of the data's standard deviations; `next_observations` become s_{t+1} - s_t."""
        return replace(
            steps,
            observations=self.observations(steps.observations),
            actions=self.actions(steps.actions),
            rewards=self.rewards(steps.rewards.unsqueeze(-1)).squeeze(-1),
            next_observations=self.changes(steps.next_observations - steps.observations),
        )

    def encode(self, steps: Steps) -> Tensor:
        """Eq. 1 for standardised steps: representations (..., latent)."""
        result: Tensor = self.encoder(
            steps.observations, steps.actions, steps.rewards, steps.next_observations
        )
        return result

    def attend(self, representations: Tensor, mask: Tensor) -> Attention:
        """Eq. 2-5, one softmax over all transitions of a lane: (lanes, trajectories, steps, latent)."""
        result: Attention = self.extractor(representations.flatten(1, 2), mask.flatten(1, 2))
        return result


@final
class Tcmrl(ContextAlgorithm):
    """The method. Context losses train the encoder side; the actor-critic sees contexts detached."""

    def __init__(self, problem: Problem, settings: TrainingSettings, config: Config) -> None:
        self._problem, self._settings, self._config = problem, settings, config
        generator = problem.generator(0)
        self.learner = ContextLearner(problem, config, generator=generator).to(problem.device)
        self.actor_critic = ActorCritic(
            settings.actor_critic, problem, latent=config.latent, generator=generator
        ).to(problem.device)
        everything = nn.ModuleDict({"context": self.learner, "actor_critic": self.actor_critic})
        self._adam = settings.optimizer.build(everything, decay_steps=problem.steps)
        self._trained = TrainedModules(
            {"all": everything}, {"all": self._adam, **self.actor_critic.optimizers()}
        )

    def update(self, batch: Batch, step: int) -> Metrics:
        generator = self._problem.generator(step)
        context_loss, context, metrics = self.context_losses(batch, generator)
        rows = self.actor_critic.rows(batch.transitions, context)
        self.actor_critic.train_dual(rows, generator)
        actor_critic_loss, more = self.actor_critic.losses(rows, generator)
        self._adam.step(context_loss + actor_critic_loss, steps_done=step - 1)
        self.actor_critic.after_step()
        return {name: each.detach() for name, each in (metrics | more).items()}

    def context_losses(self, batch: Batch, generator: torch.Generator) -> tuple[Tensor, Tensor, Metrics]:
        """The weighted sum of the context losses, the tasks' contexts (tasks, latent), and the terms by name.

        Contexts come from the context trajectories alone; the execution trajectories are what rewards
        are estimated on, and further examples of each task for the distance-metric loss.
        """
        learner, config, weights = self.learner, self._config, self._config.weights
        context, execution = learner.standardized(batch.context), learner.standardized(batch.execution)
        representations = learner.encode(context)
        attention = learner.attend(representations, context.mask)
        terms: Metrics = {}
        if weights.positive or weights.negative:
            terms |= self._reward_losses(attention, execution, generator)
        if config.sparsity == "literal":
            terms["sparsity"] = losses.literal_sparsity_loss(attention.weights, attention.mask)
        else:
            terms["sparsity"] = losses.sparsity_loss(attention.scores, attention.mask)
        if weights.contrastive:
            terms["contrastive"] = self._contrastive_loss(batch, representations, context.mask)
        if weights.distance:
            terms["distance"] = self._distance_loss(representations, context.mask, execution)
        if weights.orthogonality:
            terms["orthogonality"] = losses.orthogonality_loss(attention.weights)
        total = torch.stack([getattr(weights, name) * each for name, each in terms.items()]).sum()
        metrics = {f"loss/{name}": each for name, each in terms.items()}
        metrics["context/largest_weight"] = attention.weights.amax(dim=-1).mean()
        metrics["context/spread"] = attention.context.std(dim=0).mean()
        return total, attention.context, metrics

    def _reward_losses(
        self, attention: Attention, execution: Steps, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Eq. 7 and 8, or 17 and 18; rewards in standard deviations, and returns divided by the horizon.

        L_neg sees the estimator with its parameters held fixed (paper, end of section 4.1.1).
        """
        estimator, config, mask = self.learner.estimator, self._config, execution.mask
        sparse = isinstance(estimator, TrajectoryRewardEstimator)
        rewards = execution.rewards / self._problem.horizon if sparse else execution.rewards
        scale = config.negative_noise / (self._problem.horizon if sparse else 1.0)
        noise = scale * torch.randn(rewards.shape, generator=generator).to(rewards.device)
        wrong = losses.negative_rewards(rewards, mask, kind=config.negative_reward, noise=noise)
        reverse = losses.reverse_context(
            attention.representations,
            attention.weights,
            attention.mask,
            literal=config.reverse_scale == "sum",
        )
        inputs = (execution.observations, execution.actions, mask)
        predicted = estimator(*inputs, attention.context)
        misled = call_frozen(estimator, *inputs, reverse)
        if sparse:
            return {
                "positive": losses.positive_return_loss(predicted, rewards, mask),
                "negative": losses.negative_return_loss(misled, wrong, mask),
            }
        return {
            "positive": losses.positive_reward_loss(predicted, rewards, mask),
            "negative": losses.negative_reward_loss(misled, wrong, mask),
        }

    def _contrastive_loss(self, batch: Batch, representations: Tensor, mask: Tensor) -> Tensor:
        """Eq. 11 over all windows of the context trajectories, or over windows that the sampler drew."""
        if self._settings.batch.windows:
            windows = self.learner.standardized(batch.windows)
            representations, mask = self.learner.encode(windows), windows.mask
        return losses.task_contrastive_loss(
            representations,
            mask,
            self.learner.similarity,
            window_length=self._settings.batch.window_length,
            temperature=self._config.temperature,
        )

    def _distance_loss(self, representations: Tensor, mask: Tensor, execution: Steps) -> Tensor:
        """FOCAL's loss over the contexts of single trajectories, execution ones included."""
        learner = self.learner
        representations = torch.cat([representations, learner.encode(execution)], dim=1)
        mask = torch.cat([mask, execution.mask], dim=1)
        contexts = learner.extractor(representations.flatten(0, 1), mask.flatten(0, 1)).context
        tasks = torch.arange(len(mask), device=contexts.device).repeat_interleave(mask.shape[1])
        return losses.distance_metric_loss(contexts, tasks)

    def context(self, trajectories: Sequence[Sequence[Trajectory]]) -> Float[Tensor, "lanes latent"]:
        return self.attention(trajectories).context

    def attention(self, trajectories: Sequence[Sequence[Trajectory]]) -> Attention:
        with torch.no_grad():
            steps = self.learner.standardized(pack(trajectories, self._problem.device))
            return self.learner.attend(self.learner.encode(steps), steps.mask)

    def policy(
        self, observations: Float[Tensor, "lanes observation"], context: Float[Tensor, "lanes latent"]
    ) -> Float[Tensor, "lanes action"]:
        return self.actor_critic.act(observations, context)

    def tensors(self) -> dict[str, Tensor]:
        return self._trained.tensors()

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        self._trained.load_tensors(tensors)
