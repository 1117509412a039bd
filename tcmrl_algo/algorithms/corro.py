"""CORRO (Yuan and Lu, 2022, arXiv 2206.10442): contrast with transitions of other outcomes, and attention.

Where tasks are visited differently, (s, a) alone tells them apart. CORRO's negatives share (s, a) with their
query, so that only r and s' can tell. Every stage trains its own network while the others stay as they are:

1. `cvae`: a conditional VAE, q(z | s, a, r, s') and p(r, s' | z, s, a), of all training tasks together,

       L = L_outcome + kl_weight KL(q || N(0, I)).

2. `encoder`: z_t = e(s_t, a_t, r_t, s_{t+1}) of length 1, by InfoNCE. Query and key are transitions of one
   task; negatives are the query's (s, a) with 16 (r, s') that the decoder makes of z from the prior.
3. `policy`: the actor-critic under z = sum_t softmax_t(w . z_t) z_t. The losses of both Q alone train w; V,
   the policy and targets see z detached.

Reward randomisation (`reward_noise`) makes negatives by noise on r instead. It needs no VAE: the second stage
takes over the steps of the first, so that the policy gets the same number in every variant. Where tasks
differ in dynamics alone, such negatives are beside the point; `change_noise`, noise on s', is our
counterpart.

Our inferences: how the steps of a run are divided, because the published numbers belong to a budget of their
own; that w has no bias, which the softmax would ignore; and two scales. (a) Noise counts in standard
deviations of the data, because 0.5 means much less beside rewards of -20 than beside those of 0 or 1. Where
all z are nearly equal, the loss is a constant plus a multiple of E|q - k|^2 - E|q - n|^2: unless negatives
lie farther from the query than other transitions of its task do, the encoder makes all z equal. With 0.5
standard deviations it did so for the first 250 to 500 steps on point-robot; with 1, near the published 0.5
there, it did not. (b) With the published weight of the divergence, beside standardised errors, the VAE's
rewards spread too little, to the same effect; hence a smaller one.

A weakness of the method: a VAE's s' are not exact, and the encoder may tell made transitions from real ones
instead of tasks. On point-robot, after 2,000 steps of the second stage, the loss was 0.6; with the true s' in
the negatives it was 2.2, and contexts told tasks apart better.

Deviations: the actor-critic is ours, as for all methods; CORRO has SAC with two target Q. Encoder and VAE
read standardised transitions, with s' - s for s'. Pairs are spread evenly over the tasks of a batch; the
published code draws a task for every pair. Query and key are independent draws, hence the same once in as
many draws as a task has transitions. A context may hold several trajectories under one softmax; the published
one holds one. The published code trains the VAE on all tasks, test tasks included; here all stages see
training tasks alone.
"""

from collections.abc import Sequence
from typing import ClassVar, Literal, final

import torch
from jaxtyping import Bool, Float
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn import functional

from tcmrl_algo.algorithms.core.context import (
    ContextAlgorithm,
    ContextEncoder,
    ContextLearner,
    ContextLosses,
    EncoderInputs,
    policy_transitions,
)
from tcmrl_algo.algorithms.core.losses import Scalar, gaussian_divergence
from tcmrl_algo.algorithms.core.method import SHARED_SEARCH, Algorithm, Factors, Method, MethodConfig, Search
from tcmrl_algo.algorithms.core.networks import SMALLEST_SCALE, Attention, Perceptron
from tcmrl_algo.algorithms.core.problem import Problem, Stage
from tcmrl_algo.algorithms.core.settings import TrainingSettings
from tcmrl_data import Batch, BatchRequest, Steps, Trajectories, Windows

CVAE, ENCODER, POLICY = "cvae", "encoder", "policy"
"""The stages."""


class CorroConfig(MethodConfig):
    """The `[training.corro]` table. The contrast has no weight: it alone trains the encoder.

    Attributes:
        latent: size of representations and contexts (published code: 5; 40 for Hopper, 32 for Walker).
        encoder_hidden: widths of the transition encoder (published code: 64 x 2; 128 x 2 for Hopper, Walker).
        negatives: where their outcomes come from: a `cvae`, noise on rewards (`reward_noise`, reward
            randomisation), or noise on next states (`change_noise`, ours).
        num_negatives: of every query (published code: 16).
        noise: standard deviation of the noise (published code: 0.5, `raw`).
        noise_unit: that of `noise`: the standard deviation of rewards, or changes of state, in the data
            (`std`, ours), or theirs (`raw`).
        temperature: tau (published code: 0.1).
        pairs_per_task: queries of every task of a batch (published code: 64 per batch of any tasks; 4 are as
            many with 16 tasks).
        cvae_latent: size of the VAE's z (published code: 5; 64 for Hopper, Walker).
        cvae_hidden: widths of its encoder and decoder (published code: 64; 128 for Hopper, Walker).
        kl_weight: of its divergence from the prior (published code: 0.2, beside errors in raw units).
        cvae_share: of `run.steps`, for the first stage; without a VAE the second one takes them (ours).
        encoder_share: of `run.steps`, for the second stage (ours; published code: as many as for the policy).
    """

    latent: int = Field(default=5, ge=1)
    encoder_hidden: tuple[int, ...] = (64, 64)
    negatives: Literal["cvae", "reward_noise", "change_noise"] = "cvae"
    num_negatives: int = Field(default=16, ge=1)
    noise: float = Field(default=1.0, gt=0)
    noise_unit: Literal["std", "raw"] = "std"
    temperature: float = Field(default=0.1, gt=0)
    pairs_per_task: int = Field(default=4, ge=1)
    cvae_latent: int = Field(default=5, ge=1)
    cvae_hidden: tuple[int, ...] = (64,)
    kl_weight: float = Field(default=0.05, ge=0)
    cvae_share: float = Field(default=0.1, gt=0, lt=1)
    encoder_share: float = Field(default=0.4, gt=0, lt=1)

    @model_validator(mode="after")
    def _policy_has_a_share(self) -> "CorroConfig":
        if self.cvae_share + self.encoder_share >= 1:
            raise ValueError(
                f"cvae_share, {self.cvae_share}, and encoder_share, {self.encoder_share}, must sum to less "
                "than 1; the rest trains the policy"
            )
        return self


def relabelled_contrastive_loss(
    queries: Float[Tensor, "rows latent"],
    keys: Float[Tensor, "rows latent"],
    negatives: Float[Tensor, "rows negatives latent"],
    *,
    temperature: float,
) -> Scalar:
    """CORRO (Yuan and Lu, 2022): mean of -log( e(q.k) / (e(q.k) + sum_n e(q.n)) ), e(x) = exp(x / tau).

    InfoNCE whose negatives belong to one query alone, where `info_nce` takes the keys of all others. Without
    a negative the loss is 0.

    Args:
        keys: of other transitions of the same task.
        negatives: of the queries' states and actions with the outcomes of another task.
    """
    matching = torch.einsum("rd,rd->r", queries, keys).unsqueeze(-1)
    others = torch.einsum("rd,rnd->rn", queries, negatives)
    logits = torch.cat([matching, others], dim=-1) / temperature
    return -torch.log_softmax(logits, dim=-1)[:, 0].mean()


def outcome_error(
    predicted: Float[Tensor, "rows outcomes"], outcomes: Float[Tensor, "rows outcomes"]
) -> Scalar:
    """CORRO's reconstruction: mean (r_hat - r)^2 + mean over dimensions of (s'_hat - s')^2, mean over rows.

    Deviation: the published code compares raw rewards and states, so that their units decide how much either
    counts; hand over standardised rewards and changes of state.

    Args:
        predicted: r_hat, then s'_hat, as `outcomes`.
        outcomes: r, then s', or s' - s.
    """
    errors = (predicted - outcomes).square()
    return errors[:, :1].mean() + errors[:, 1:].mean()


@final
class OutcomeModel(nn.Module):
    """The conditional VAE of standardised outcomes (r, s' - s) of (s, a), over all training tasks."""

    def __init__(
        self, state_action: int, outcomes: int, config: CorroConfig, *, generator: torch.Generator
    ) -> None:
        super().__init__()
        self.latent = config.cvae_latent
        first, hidden = state_action + outcomes, config.cvae_hidden
        self.encoder = Perceptron((first, *hidden, 2 * self.latent), generator=generator)
        self.decoder = Perceptron((self.latent + state_action, *hidden, outcomes), generator=generator)

    def posterior(
        self, inputs: Float[Tensor, "rows inputs"]
    ) -> tuple[Float[Tensor, "rows code"], Float[Tensor, "rows code"]]:
        """Mean and log variance of q(z | s, a, r, s')."""
        mean, log_variance = self.encoder(inputs).chunk(2, dim=-1)
        return mean, log_variance

    def decode(
        self, codes: Float[Tensor, "*rows code"], state_actions: Float[Tensor, "*rows inputs"]
    ) -> Float[Tensor, "*rows outcomes"]:
        """The mean of p(r, s' - s | z, s, a)."""
        result: Tensor = self.decoder(torch.cat([codes, state_actions], dim=-1))
        return result


@final
class Aggregator(nn.Module):
    """One linear score per representation and their softmax: which transitions the context consists of."""

    def __init__(self, latent: int, *, generator: torch.Generator) -> None:
        super().__init__()
        bound = latent**-0.5
        self.direction = nn.Parameter(torch.empty(latent).uniform_(-bound, bound, generator=generator))

    def forward(
        self, representations: Float[Tensor, "lanes steps latent"], mask: Bool[Tensor, "lanes steps"]
    ) -> Attention:
        """Attention over each lane's real transitions, of which there must be at least one."""
        scores = representations @ self.direction
        weights = torch.softmax(torch.where(mask, scores, -torch.inf), dim=-1)
        context = torch.einsum("lt,ltd->ld", weights, torch.where(mask.unsqueeze(-1), representations, 0.0))
        return Attention(representations, scores, weights, context, mask)


@final
class CorroLearner(ContextLearner):
    """Transition encoder and aggregator, and the VAE where negatives come from one."""

    noise_scale: Tensor

    def __init__(self, problem: Problem, config: CorroConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        self.latent, self._config, self._stages = config.latent, config, problem.stages
        self.encoder = ContextEncoder(
            problem, latent=config.latent, hidden=config.encoder_hidden, generator=generator
        )
        self.aggregator = Aggregator(config.latent, generator=generator)
        outcomes = 1 + problem.observation_dim
        if config.negatives == "cvae":
            self.cvae = OutcomeModel(self.encoder.state_action, outcomes, config, generator=generator)
        scale = torch.zeros(outcomes)
        scale[slice(0, 1) if config.negatives == "reward_noise" else slice(1, None)] = config.noise
        if config.noise_unit == "raw":
            scale = scale / self.encoder.scaling.scale[self.encoder.state_action :]
        else:  # what hardly varies in the data is not divided: noise there would tell negatives from the rest
            scale[1:][problem.change_std < SMALLEST_SCALE] = 0.0
        self.register_buffer("noise_scale", scale, persistent=False)

    def parts(self, stage: str) -> Sequence[str]:
        return {CVAE: ("cvae",), ENCODER: ("encoder",), POLICY: ("aggregator",)}[stage]

    def losses(self, batch: Batch, step: int, generator: torch.Generator) -> ContextLosses:
        """The loss of the step's stage; in the last one, contexts for the critics to train."""
        stage = self._stages.at(step).stage
        if stage == POLICY:
            return self._policy_losses(batch)
        if stage == CVAE:
            return self._cvae_losses(self.encoder.read(batch["transitions"]), generator)
        return self._encoder_losses(self.encoder.read(batch["pairs"]), generator)

    def _cvae_losses(self, steps: EncoderInputs, generator: torch.Generator) -> ContextLosses:
        """What the decoder lacks in outcomes under codes from q, and how much the codes tell."""
        inputs = steps.inputs.flatten(0, 2)
        mean, log_variance = self.cvae.posterior(inputs)
        noise = torch.randn(mean.shape, generator=generator).to(mean.device)
        codes = mean + (0.5 * log_variance).exp() * noise
        predicted = self.cvae.decode(codes, steps.state_actions.flatten(0, 2))
        outcome = outcome_error(predicted, steps.outcomes.flatten(0, 2))
        prior = torch.zeros_like(mean), torch.ones_like(mean)
        divergence = gaussian_divergence(mean, log_variance.exp(), *prior).mean()
        metrics = {"loss/outcome": outcome, "loss/divergence": divergence}
        return ContextLosses(outcome + self._config.kl_weight * divergence, None, metrics)

    def _encoder_losses(self, steps: EncoderInputs, generator: torch.Generator) -> ContextLosses:
        """InfoNCE; its gradient comes through queries, keys and negatives, but not through the VAE."""
        queries, keys = (part.flatten(0, 2) for part in steps.inputs.chunk(2, dim=1))
        rows = torch.cat([queries.unsqueeze(1), keys.unsqueeze(1), self.negatives(queries, generator)], dim=1)
        query, key, negatives = self.represent(rows).split([1, 1, self._config.num_negatives], dim=1)
        contrast = relabelled_contrastive_loss(
            query.squeeze(1), key.squeeze(1), negatives, temperature=self._config.temperature
        )
        metrics = {"loss/contrastive": contrast, "context/spread": query.std(dim=0).mean()}
        return ContextLosses(contrast, None, metrics)

    def _policy_losses(self, batch: Batch) -> ContextLosses:
        attention = self.attention(batch["context"])
        metrics = {
            "context/largest_weight": attention.weights.amax(dim=-1).mean(),
            "context/spread": attention.context.std(dim=0).mean(),
        }
        zero = attention.context.new_zeros(())
        return ContextLosses(zero, attention.context, metrics, critic_gradient=True)

    def negatives(
        self, queries: Float[Tensor, "rows inputs"], generator: torch.Generator
    ) -> Float[Tensor, "rows negatives inputs"]:
        """Standardised transitions with the states and actions of the queries and other outcomes."""
        widths = [self.encoder.state_action, queries.shape[-1] - self.encoder.state_action]
        shape = (len(queries), self._config.num_negatives)
        state_actions, outcomes = (
            part.unsqueeze(1).expand(*shape, -1) for part in queries.split(widths, dim=-1)
        )
        width = self.cvae.latent if self._config.negatives == "cvae" else widths[1]
        noise = torch.randn(*shape, width, generator=generator).to(queries.device)
        if self._config.negatives == "cvae":
            with torch.no_grad():
                drawn = self.cvae.decode(noise, state_actions)
        else:
            drawn = outcomes + self.noise_scale * noise
        return torch.cat([state_actions, drawn], dim=-1)

    def represent(self, inputs: Float[Tensor, "*rows inputs"]) -> Float[Tensor, "*rows latent"]:
        """Standardised transitions as vectors z of length 1."""
        return functional.normalize(self.encoder.perceptron(inputs), dim=-1)

    def attention(self, steps: Steps) -> Attention:
        """One softmax over all transitions of a lane; the encoder gets no gradient."""
        with torch.no_grad():
            representations = self.represent(self.encoder.read(steps).inputs)
        result: Attention = self.aggregator(representations.flatten(1, 2), steps.mask.flatten(1, 2))
        return result

    def context(self, steps: Steps) -> Float[Tensor, "lanes latent"]:
        return self.attention(steps).context


@final
class Corro(Method[CorroConfig]):
    """The plug-in."""

    name = "corro"
    Config = CorroConfig
    search: ClassVar[Search] = {**SHARED_SEARCH, "corro.temperature": Factors(0.1, 10.0)}

    def batch_request(self, settings: TrainingSettings, config: CorroConfig) -> BatchRequest:
        """Transitions for the actor-critic, and trajectories of the same task for the context."""
        batch = settings.batch
        return BatchRequest(
            batch.tasks,
            {
                "policy": policy_transitions(settings),
                "context": Trajectories(batch.context_trajectories),
            },
        )

    def stages(self, settings: TrainingSettings, config: CorroConfig) -> tuple[Stage, ...]:
        """VAE, if there is one, encoder, and policy.

        The first two read windows of one step: transitions of the snapshots that contexts come from.
        """
        steps, tasks = settings.run.steps, settings.batch.tasks
        cvae = max(1, round(config.cvae_share * steps))
        encoder = max(1, round(config.encoder_share * steps))
        policy = Stage(POLICY, steps - cvae - encoder, self.batch_request(settings, config))
        pairs = BatchRequest(tasks, {"pairs": Windows(2 * config.pairs_per_task, 1)})
        if config.negatives != "cvae":
            return Stage(ENCODER, cvae + encoder, pairs), policy
        transitions = BatchRequest(tasks, {"transitions": Windows(settings.batch.transitions, 1)})
        return Stage(CVAE, cvae, transitions), Stage(ENCODER, encoder, pairs), policy

    def create(self, problem: Problem, settings: TrainingSettings, config: CorroConfig) -> Algorithm:
        learner = CorroLearner(problem, config, generator=problem.generator(0))
        return ContextAlgorithm(problem, settings, learner=learner)
