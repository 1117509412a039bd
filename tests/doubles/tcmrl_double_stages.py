"""Three stages with networks of their own: a reward model, an encoder, weights that the critic trains."""

from collections.abc import Sequence

import torch
from torch import Tensor

from tcmrl_algo import (
    Algorithm,
    ContextAlgorithm,
    ContextLearner,
    ContextLosses,
    Method,
    MethodConfig,
    Problem,
    Stage,
    TrainingSettings,
    policy_transitions,
)
from tcmrl_algo.algorithms.core.networks import linear
from tcmrl_data import Batch, BatchRequest, Steps, Trajectories, Transitions


class StagesConfig(MethodConfig):
    """Settings.

    Attributes:
        model_steps: of the first stage.
        encoder_steps: of the second stage.
    """

    model_steps: int = 2
    encoder_steps: int = 2


class StagesLearner(ContextLearner):
    """Explains by contexts what a model without contexts gets wrong about rewards."""

    latent = 4

    def __init__(self, problem: Problem) -> None:
        super().__init__()
        generator, inputs = problem.generator(0), problem.observation_dim + problem.action_dim
        self.stages = problem.stages
        self.model = linear(inputs, 1, generator)
        self.encoder = linear(inputs + 1, self.latent, generator)
        self.scores = linear(self.latent, 1, generator)

    def parts(self, stage: str) -> Sequence[str]:
        return {"model": ("model",), "encoder": ("encoder",), "policy": ("scores",)}[stage]

    def errors(self, steps: Steps) -> Tensor:
        inputs = torch.cat([steps.observations, steps.actions], dim=-1)
        return steps.rewards - self.model(inputs).squeeze(-1)

    def represent(self, steps: Steps) -> Tensor:
        errors = self.errors(steps).unsqueeze(-1)
        return torch.tanh(self.encoder(torch.cat([steps.observations, steps.actions, errors], dim=-1)))

    def losses(self, batch: Batch, step: int, generator: torch.Generator) -> ContextLosses:
        stage = self.stages.at(step).stage
        if stage == "policy":
            context = self.context(batch["context"])
            return ContextLosses(context.new_zeros(()), context, {}, critic_gradient=True)
        if stage == "model":
            loss = self.errors(batch["rows"]).square().mean()
        else:
            steps = batch["context"]
            explained = self.represent(steps).mean(dim=-1)
            loss = (self.errors(steps) - explained)[steps.mask].square().mean()
        return ContextLosses(loss, None, {f"loss/{stage}": loss})

    def context(self, steps: Steps) -> Tensor:
        representations, mask = self.represent(steps).flatten(1, 2), steps.mask.flatten(1, 2)
        scores = torch.where(mask, self.scores(representations).squeeze(-1), -torch.inf)
        return torch.einsum("lt,ltd->ld", torch.softmax(scores, dim=-1), representations)


class StagesMethod(Method[StagesConfig]):
    """The plug-in."""

    name = "double_stages"
    Config = StagesConfig

    def batch_request(self, settings: TrainingSettings, config: StagesConfig) -> BatchRequest:
        kinds = {"policy": policy_transitions(settings), "context": Trajectories(2)}
        return BatchRequest(settings.batch.tasks, kinds)

    def stages(self, settings: TrainingSettings, config: StagesConfig) -> tuple[Stage, ...]:
        tasks, rest = settings.batch.tasks, settings.run.steps - config.model_steps - config.encoder_steps
        return (
            Stage("model", config.model_steps, BatchRequest(tasks, {"rows": Transitions(32)})),
            Stage("encoder", config.encoder_steps, BatchRequest(tasks, {"context": Trajectories(1)})),
            Stage("policy", rest, self.batch_request(settings, config)),
        )

    def create(self, problem: Problem, settings: TrainingSettings, config: StagesConfig) -> Algorithm:
        return ContextAlgorithm(problem, settings, learner=StagesLearner(problem))
