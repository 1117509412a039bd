"""A method whose context predicts the rewards of other transitions of the task.

Every transition of the context trajectories is encoded, and the context is the mean of all. A second network
predicts the rewards of further trajectories from their states, their actions and the context; the squared
error trains both networks.
"""

from typing import final

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from tcmrl_algo.algorithms.core.context import (
    ContextAlgorithm,
    ContextEncoder,
    ContextLearner,
    ContextLosses,
    policy_transitions,
)
from tcmrl_algo.algorithms.core.method import Algorithm, Method, MethodConfig
from tcmrl_algo.algorithms.core.networks import Perceptron, mean_representation
from tcmrl_algo.algorithms.core.problem import Problem
from tcmrl_algo.algorithms.core.settings import TrainingSettings
from tcmrl_data import Batch, BatchRequest, Steps, Trajectories


class RewardRegressionConfig(MethodConfig):
    """The `[training.reward_regression]` table.

    Attributes:
        latent: size of the context.
        hidden: widths of the encoder and of the predictor.
    """

    latent: int = Field(default=8, ge=1)
    hidden: tuple[int, ...] = (64, 64)


@final
class RewardRegressionLearner(ContextLearner):
    """Encoder, mean and predictor."""

    def __init__(
        self, problem: Problem, config: RewardRegressionConfig, *, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.latent = config.latent
        self.encoder = ContextEncoder(
            problem, latent=config.latent, hidden=config.hidden, generator=generator
        )
        sizes = (self.encoder.state_action + config.latent, *config.hidden, 1)
        self.predictor = Perceptron(sizes, generator=generator)

    def losses(self, batch: Batch, step: int, generator: torch.Generator) -> ContextLosses:
        """The mean squared error of rewards, in units of the data's standard deviation."""
        context = self.context(batch["context"])
        read = self.encoder.read(batch["execution"])
        per_step = context[:, None, None].expand(*read.mask.shape, -1)
        predicted = self.predictor(torch.cat([read.state_actions, per_step], dim=-1)).squeeze(-1)
        error = (predicted - read.rewards)[read.mask].square().mean()
        return ContextLosses(error, context, {"loss/reward": error})

    def context(self, steps: Steps) -> Float[Tensor, "lanes latent"]:
        (representations,) = self.encoder(self.encoder.read(steps))
        return mean_representation(representations.flatten(1, 2), steps.mask.flatten(1, 2))


@final
class RewardRegression(Method[RewardRegressionConfig]):
    """The plug-in."""

    name = "reward_regression"
    Config = RewardRegressionConfig

    def batch_request(self, settings: TrainingSettings, config: RewardRegressionConfig) -> BatchRequest:
        batch = settings.batch
        return BatchRequest(
            batch.tasks,
            {
                "policy": policy_transitions(settings),
                "context": Trajectories(batch.context_trajectories),
                "execution": Trajectories(batch.execution_trajectories, apart_from="context"),
            },
        )

    def create(
        self, problem: Problem, settings: TrainingSettings, config: RewardRegressionConfig
    ) -> Algorithm:
        learner = RewardRegressionLearner(problem, config, generator=problem.generator(0))
        return ContextAlgorithm(problem, settings, learner=learner)
