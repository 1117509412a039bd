"""FOCAL (Li et al., 2021): the mean of transition representations as context, trained by distances alone."""

from typing import ClassVar, Literal, final

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from tcmrl_algo.algorithms.core.context import (
    ContextAlgorithm,
    ContextEncoder,
    ContextLearner,
    ContextLosses,
    trajectory_request,
)
from tcmrl_algo.algorithms.core.losses import distance_metric_loss
from tcmrl_algo.algorithms.core.method import SHARED_SEARCH, Algorithm, Factors, Method, MethodConfig, Search
from tcmrl_algo.algorithms.core.networks import mean_representation
from tcmrl_algo.algorithms.core.problem import Problem
from tcmrl_algo.algorithms.core.settings import TrainingSettings
from tcmrl_data import Batch, BatchRequest, Steps


class FocalConfig(MethodConfig):
    """The `[training.focal]` table. No weight: one loss alone trains the encoder, and Adam has no scale.

    Attributes:
        latent: size of representations and contexts (published code of TCMRL: 20).
        encoder_hidden: widths of the context encoder (published code: 200 x 3).
        epsilon: bounds the repulsion of two tasks' contexts (published code: 0.1).
        attraction: a task's contexts attract each other by `square`, d^2 (FOCAL's paper), or by `root`,
            sqrt(d^2 + 0.001) (its published code).
    """

    latent: int = Field(default=20, ge=1)
    encoder_hidden: tuple[int, ...] = (200, 200, 200)
    epsilon: float = Field(default=0.1, gt=0)
    attraction: Literal["square", "root"] = "square"


@final
class FocalLearner(ContextLearner):
    """Encoder and mean."""

    def __init__(self, problem: Problem, config: FocalConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        self.latent, self._config = config.latent, config
        self.encoder = ContextEncoder(
            problem, latent=config.latent, hidden=config.encoder_hidden, generator=generator
        )

    def losses(self, batch: Batch, step: int, generator: torch.Generator) -> ContextLosses:
        """The distances of single trajectories' contexts, execution trajectories among them."""
        groups = [self.encoder.read(batch["context"]), self.encoder.read(batch["execution"])]
        representations = torch.cat(self.encoder(*groups), dim=1)
        mask = torch.cat([group.mask for group in groups], dim=1)
        single = mean_representation(representations.flatten(0, 1), mask.flatten(0, 1))
        distance = distance_metric_loss(
            single.unflatten(0, mask.shape[:2]),
            epsilon=self._config.epsilon,
            attraction=self._config.attraction,
        )
        num_context = batch["context"].mask.shape[1]
        context = mean_representation(
            representations[:, :num_context].flatten(1, 2), mask[:, :num_context].flatten(1, 2)
        )
        metrics = {"loss/distance": distance, "context/spread": context.std(dim=0).mean()}
        return ContextLosses(distance, context, metrics)

    def context(self, steps: Steps) -> Float[Tensor, "lanes latent"]:
        (representations,) = self.encoder(self.encoder.read(steps))
        return mean_representation(representations.flatten(1, 2), steps.mask.flatten(1, 2))


@final
class Focal(Method[FocalConfig]):
    """The plug-in."""

    name = "focal"
    Config = FocalConfig
    search: ClassVar[Search] = {**SHARED_SEARCH, "focal.epsilon": Factors(0.1, 10.0)}

    def batch_request(self, settings: TrainingSettings, config: FocalConfig) -> BatchRequest:
        """The `[training.batch]` table without windows."""
        return trajectory_request(settings)

    def create(self, problem: Problem, settings: TrainingSettings, config: FocalConfig) -> Algorithm:
        learner = FocalLearner(problem, config, generator=problem.generator(0))
        return ContextAlgorithm(problem, settings, learner=learner)
