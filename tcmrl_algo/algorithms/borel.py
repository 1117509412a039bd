"""BOReL (Dorfman et al., 2021): a policy that acts by its belief of the task, filtered step by step.

First stage, a recurrent VAE (VariBAD's): after t steps a GRU gives the belief b_t = N(mu_t, sigma_t^2) of
the task variable. A draw z_t decodes the rewards of all steps, past and future; successive beliefs are held
together:

    L = sum_t error of what z_t predicts + 0.05 sum_t KL(b_t || b_{t-1}),  KL_0 against N(0, I).

A lane is `episodes_per_belief` episodes of a task, one after the other; the belief goes on where an episode
ends.

Second stage, state relabelling: the VAE is frozen, and the actor-critic learns from (s_t, mu_t, log
sigma_t^2) and (s_{t+1}, mu_{t+1}, log sigma_{t+1}^2). At test the belief starts from the prior and changes
with every step.

Our inferences and choices:

- The actor-critic is that of the other methods, where the published code has SAC, which on narrow offline
  data overestimates. Its rows are the steps of the same lanes; beliefs are computed anew for every batch,
  by one pass, and episodes are paired at random in each, so that relabelling needs no copy of the data.
- Lanes hold as many trajectories as the recipe's largest context, rounded up to whole lanes. In the plane
  these are about as many transitions as in the other methods' batches, elsewhere several times as many. As
  many as those have, of one lane or of four, served worse on half-cheetah-vel: steps of a lane are alike.
- Of all draws of t, `elbo_terms` per lane are decoded, which estimates the same sum. Values are
  standardised, and changes of state stand for next states.
- Filtered are the first `episodes_per_belief` - 1 trajectories of a context and the episode that is run,
  since the GRU has seen no more in training; published tests end there too. With the latest trajectories in
  place of the first, beliefs drifted away from the task, episode by episode, on the policy's own data. The
  first episodes are collected by the same policy.
- Rewards are decoded from (z, s, a, s') everywhere (published code, where rewards are sparse: from z and s').
- The paper's remedy for tasks that data confound evaluates one task's reward function on another's episodes.
  No learner here is given reward functions: a dataset is relabelled instead, by `tcmrl-data relabel`, which
  refuses tasks that differ in more than rewards, and lanes then pair a task's own episodes with others'.
- The belief-averaged reward is left out, as it is off in the published configurations, and the dense
  rewards of `actor_critic.rewards` are refused, since batches hold them for single transitions alone.
"""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, Literal, NamedTuple, final

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from tcmrl_algo.algorithms.core.actor_critic.base import ActorCritic
from tcmrl_algo.algorithms.core.context import ContextAlgorithm, ContextLearner, ContextLosses
from tcmrl_algo.algorithms.core.losses import Scalar, gaussian_divergence
from tcmrl_algo.algorithms.core.method import (
    SHARED_SEARCH,
    Algorithm,
    Capabilities,
    Factors,
    FunctionController,
    Method,
    MethodConfig,
    Search,
)
from tcmrl_algo.algorithms.core.networks import Perceptron, Standardizer, linear
from tcmrl_algo.algorithms.core.problem import Problem, Stage, pad_trajectories
from tcmrl_algo.algorithms.core.settings import TrainingSettings
from tcmrl_data import (
    Batch,
    BatchRequest,
    Controller,
    LaneTransition,
    Steps,
    Trajectories,
    Trajectory,
    UniformController,
)

BELIEF_STAGE, POLICY_STAGE = "belief", "policy"


class BorelConfig(MethodConfig):
    """The `[training.borel]` table.

    Attributes:
        belief: dimensions of the task variable; the context is its mean and log variance (published code: 5).
        recurrent_hidden: state of the GRU (published code: 128).
        action_embedding: width of embedded actions (published code: 16).
        state_embedding: width of embedded states (published code: 32).
        reward_embedding: width of embedded rewards (published code: 16).
        decoder_hidden: widths of the decoders (published code: 32 x 2).
        kl_weight: of the divergences between successive beliefs (published code: 0.05).
        decode_state: also predicts changes of the state, without which a belief cannot tell tasks that pay
            alike (published code: off everywhere; ours: on where tasks differ in their dynamics).
        elbo_terms: drawn steps t per lane whose z_t is decoded (ours; published code: all).
        reconstruction: whether a prediction's errors are a `mean` over steps (published code) or their `sum`
            (paper), which makes the divergences weigh less.
        episodes_per_belief: episodes of a task that are filtered one after the other (published code: 2).
        explore: who collects the first episodes: the `policy`, whose belief starts from the prior, and later
            from that after the first episode (published code), or `uniform` actions (ours).
        vae_share: share of all steps that train the belief; the others train the policy (ours).
    """

    belief: int = Field(default=5, ge=1)
    recurrent_hidden: int = Field(default=128, ge=1)
    action_embedding: int = Field(default=16, ge=1)
    state_embedding: int = Field(default=32, ge=1)
    reward_embedding: int = Field(default=16, ge=1)
    decoder_hidden: tuple[int, ...] = (32, 32)
    kl_weight: float = Field(default=0.05, ge=0)
    decode_state: bool = False
    elbo_terms: int = Field(default=8, ge=1)
    reconstruction: Literal["mean", "sum"] = "mean"
    episodes_per_belief: int = Field(default=2, ge=2)
    explore: Literal["policy", "uniform"] = "policy"
    vae_share: float = Field(default=0.25, gt=0, lt=1)


def belief_divergence(
    means: Float[Tensor, "lanes beliefs latent"],
    log_variances: Float[Tensor, "lanes beliefs latent"],
    mask: Bool[Tensor, "lanes steps"],
) -> Scalar:
    """Sum over t of KL(b_t || b_{t-1}), with b_{-1} = N(0, I), averaged over lanes (BOReL, VariBAD).

    The gradient reaches both beliefs of a pair.
    """
    before = [functional.pad(values[:, :-1], (0, 0, 1, 0)) for values in (means, log_variances)]
    divergences = gaussian_divergence(means, log_variances.exp(), before[0], before[1].exp())
    return torch.where(belief_mask(mask), divergences, 0.0).sum(dim=1).mean()


def belief_mask(mask: Bool[Tensor, "lanes steps"]) -> Bool[Tensor, "lanes beliefs"]:
    """Which beliefs are real: b_0, and those after real steps."""
    return functional.pad(mask, (1, 0), value=True)


def belief_reconstruction(
    predicted: Float[Tensor, "lanes draws steps outputs"],
    targets: Float[Tensor, "lanes steps outputs"],
    mask: Bool[Tensor, "lanes steps"],
    *,
    over_steps: bool,
) -> Scalar:
    """Sum over t of the errors of what z_t ~ b_t predicts of all steps of its lane, averaged over lanes.

    The sum over the T + 1 beliefs is estimated by T + 1 times the mean over draws of t. Errors are squared
    and summed over outputs; over steps, published code of BOReL takes their mean, while the paper sums.

    Args:
        predicted: for every draw of t and z_t, past and future steps alike.
        over_steps: sum errors over steps instead of taking their mean.
    """
    errors = (predicted - targets.unsqueeze(1)).square().sum(dim=-1)
    sums = torch.where(mask.unsqueeze(1), errors, 0.0).sum(dim=-1).mean(dim=1)
    numbers = mask.sum(dim=-1)
    shares = sums if over_steps else sums / numbers.clamp(min=1)
    return ((numbers + 1) * shares).mean()


def recurrent(inputs: int, hidden: int, generator: torch.Generator) -> nn.GRU:
    """A GRU, batch first, with orthogonal weights and biases of 0 (published code of VariBAD and BOReL)."""
    network = nn.GRU(inputs, hidden, batch_first=True, device="meta").to_empty(device="cpu")
    for name, parameter in network.named_parameters():
        if name.startswith("bias"):
            nn.init.zeros_(parameter)
        else:
            nn.init.orthogonal_(parameter, generator=generator)
    return network


class Beliefs(NamedTuple):
    """Gaussians over the task variable.

    Attributes:
        means: (..., belief).
        log_variances: (..., belief).
    """

    means: Tensor
    log_variances: Tensor

    @property
    def context(self) -> Tensor:
        """(..., 2 belief), what the policy reads: means and log variances."""
        return torch.cat(self, dim=-1)


class StepValues(NamedTuple):
    """Standardised values of steps.

    Attributes:
        states, next_states: (..., observation_dim).
        actions: (..., action_dim).
        rewards: (..., 1).
        changes: (..., observation_dim), s_{t+1} - s_t in their own units.
    """

    states: Tensor
    actions: Tensor
    rewards: Tensor
    next_states: Tensor
    changes: Tensor


@final
class StepReader(nn.Module):
    """Standardises steps by the moments of the data."""

    def __init__(self, problem: Problem) -> None:
        super().__init__()
        self.states = Standardizer(problem.observation_mean, problem.observation_std)
        self.actions = Standardizer(problem.action_mean, problem.action_std)
        self.rewards = Standardizer(torch.tensor([problem.reward_mean]), torch.tensor([problem.reward_std]))
        self.changes = Standardizer(problem.change_mean, problem.change_std)

    def forward(
        self,
        states: Float[Tensor, "*steps observation"],
        actions: Float[Tensor, "*steps action"],
        rewards: Float[Tensor, "*steps"],
        next_states: Float[Tensor, "*steps observation"],
    ) -> StepValues:
        return StepValues(
            self.states(states),
            self.actions(actions),
            self.rewards(rewards.unsqueeze(-1)),
            self.states(next_states),
            self.changes(next_states - states),
        )


@final
class BeliefEncoder(nn.Module):
    """Filters a belief: a GRU over embeddings of a_t, s_{t+1} and r_t, and linear heads on its state."""

    def __init__(self, problem: Problem, config: BorelConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        widths = (config.action_embedding, config.state_embedding, config.reward_embedding)
        self.actions = linear(problem.action_dim, widths[0], generator)
        self.states = linear(problem.observation_dim, widths[1], generator)
        self.rewards = linear(1, widths[2], generator)
        self.recurrence = recurrent(sum(widths), config.recurrent_hidden, generator)
        self.heads = linear(config.recurrent_hidden, 2 * config.belief, generator)

    def start(self, lanes: int) -> Float[Tensor, "lanes hidden"]:
        """The state of the GRU before the first step."""
        return self.heads.weight.new_zeros(lanes, self.recurrence.hidden_size)

    def states_along(self, values: StepValues) -> Float[Tensor, "lanes beliefs hidden"]:
        """States of the GRU before the first step and after every step, by one pass over (lanes, steps)."""
        start = self.start(len(values.actions))
        if not values.actions.shape[1]:
            return start.unsqueeze(1)
        found, _ = self.recurrence(self._inputs(values), start.unsqueeze(0))
        return torch.cat([start.unsqueeze(1), found], dim=1)

    def following(
        self, hidden: Float[Tensor, "lanes hidden"], values: StepValues, active: Bool[Tensor, " lanes"]
    ) -> Float[Tensor, "lanes hidden"]:
        """States after one step of every lane; those of other than active lanes stay."""
        step = StepValues(*(value.unsqueeze(1) for value in values))
        found, _ = self.recurrence(self._inputs(step), hidden.unsqueeze(0))
        return torch.where(active.unsqueeze(-1), found.squeeze(1), hidden)

    def beliefs(self, hidden: Float[Tensor, "*lanes hidden"]) -> Beliefs:
        """The beliefs that states of the GRU hold."""
        return Beliefs(*self.heads(hidden).chunk(2, dim=-1))

    def _inputs(self, values: StepValues) -> Tensor:
        parts = (self.actions(values.actions), self.states(values.next_states), self.rewards(values.rewards))
        return torch.cat([torch.relu(part) for part in parts], dim=-1)


@final
class BeliefDecoder(nn.Module):
    """Predicts rewards, and changes of the state where asked, from a task variable z and the step.

    The reward's decoder reads z, s_{t+1}, s_t and a_t; the one of changes does not read s_{t+1}.
    """

    def __init__(self, problem: Problem, config: BorelConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        state, action, hidden = config.state_embedding, config.action_embedding, config.decoder_hidden
        self.states = linear(problem.observation_dim, state, generator)
        self.next_states = linear(problem.observation_dim, state, generator)
        self.actions = linear(problem.action_dim, action, generator)
        sizes = (config.belief + 2 * state + action, *hidden, 1)
        self.reward = Perceptron(sizes, generator=generator)
        self.change: Perceptron | None = None
        if config.decode_state:
            sizes = (config.belief + state + action, *hidden, problem.observation_dim)
            self.change = Perceptron(sizes, generator=generator)

    def forward(
        self, variables: Float[Tensor, "lanes draws belief"], values: StepValues
    ) -> Float[Tensor, "lanes draws steps outputs"]:
        """What every drawn z predicts of every step of its lane."""
        states, actions = torch.relu(self.states(values.states)), torch.relu(self.actions(values.actions))
        parts = [torch.cat([states, actions, torch.relu(self.next_states(values.next_states))], dim=-1)]
        decoders = [self.reward]
        if self.change is not None:
            decoders.append(self.change)
            parts.append(torch.cat([states, actions], dim=-1))
        shape = (*variables.shape[:2], values.actions.shape[1])
        spread = variables.unsqueeze(2).expand(*shape, -1)
        found = [
            decoder(torch.cat([spread, part.unsqueeze(1).expand(*shape, -1)], dim=-1))
            for decoder, part in zip(decoders, parts, strict=True)
        ]
        return torch.cat(found, dim=-1)

    def targets(self, values: StepValues) -> Float[Tensor, "lanes steps outputs"]:
        """What `forward` predicts."""
        return values.rewards if self.change is None else torch.cat([values.rewards, values.changes], dim=-1)


@final
class BorelLearner(ContextLearner):
    """The belief, the decoders that train it, and the actor-critic's steps beside their beliefs."""

    def __init__(self, problem: Problem, config: BorelConfig, *, generator: torch.Generator) -> None:
        super().__init__()
        self.latent, self._config, self._problem = 2 * config.belief, config, problem
        self.read = StepReader(problem)
        self.encoder = BeliefEncoder(problem, config, generator=generator)
        self.decoder = BeliefDecoder(problem, config, generator=generator)

    def parts(self, stage: str) -> Sequence[str]:
        return ("encoder", "decoder") if stage == BELIEF_STAGE else ()

    def losses(self, batch: Batch, step: int, generator: torch.Generator) -> ContextLosses:
        """The ELBO in the first stage; beliefs beside the steps of their lanes in the second."""
        lanes = joined_episodes(batch["episodes"], self._config.episodes_per_belief)
        if self._problem.stages.at(step).stage == BELIEF_STAGE:
            return self._elbo(lanes, generator)
        with torch.no_grad():
            shape = lanes.mask.shape
            context = self.beliefs(lanes)[1].context.unflatten(0, shape[:2])
        before, after = context[:, :, :-1], context[:, :, 1:]
        metrics = {"belief/spread": after[lanes.mask].std(dim=0).mean()}
        return ContextLosses(context.new_zeros(()), before, metrics, after, steps=lanes)

    def beliefs(self, lanes: Steps) -> tuple[StepValues, Beliefs]:
        """The steps' values, of all lanes of all tasks, and the beliefs before and after all steps."""
        values = self._values(lanes)
        return values, self.encoder.beliefs(self.encoder.states_along(values))

    def _values(self, lanes: Steps) -> StepValues:
        names = ("observations", "actions", "rewards", "next_observations")
        values: StepValues = self.read(*(getattr(lanes, name).flatten(0, 1) for name in names))
        return values

    def _elbo(self, lanes: Steps, generator: torch.Generator) -> ContextLosses:
        config, mask = self._config, lanes.mask.flatten(0, 1)
        values, beliefs = self.beliefs(lanes)
        drawn = self._draws(beliefs, mask, generator)
        reconstruction = belief_reconstruction(
            self.decoder(drawn, values),
            self.decoder.targets(values),
            mask,
            over_steps=config.reconstruction == "sum",
        )
        divergence = belief_divergence(*beliefs, mask)
        last = mask.sum(dim=1).view(-1, 1, 1).expand(-1, 1, config.belief)
        variances = beliefs.log_variances.exp()
        metrics = {
            "loss/reconstruction": reconstruction,
            "loss/divergence": divergence,
            "belief/prior_variance": variances[:, 0].mean(),
            "belief/last_variance": variances.gather(1, last).mean(),
        }
        return ContextLosses(reconstruction + config.kl_weight * divergence, None, metrics)

    def _draws(
        self, beliefs: Beliefs, mask: Bool[Tensor, "lanes steps"], generator: torch.Generator
    ) -> Float[Tensor, "lanes draws belief"]:
        """Draws z_t from the beliefs at uniformly drawn t of every lane."""
        shape = (len(mask), self._config.elbo_terms)
        numbers = mask.sum(dim=1, keepdim=True) + 1
        uniform = torch.rand(shape, generator=generator).to(mask.device)
        noise = torch.randn(*shape, self._config.belief, generator=generator).to(mask.device)
        times = torch.minimum((uniform * numbers).long(), numbers - 1)
        places = times.unsqueeze(-1).expand(-1, -1, self._config.belief)
        means, log_variances = (values.gather(1, places) for values in beliefs)
        return means + (0.5 * log_variances).exp() * noise

    def filtered(self, steps: Steps) -> Float[Tensor, "lanes hidden"]:
        """The GRU's state after the first `episodes_per_belief` - 1 trajectories of every lane."""
        number = min(steps.mask.shape[1], self._config.episodes_per_belief - 1)
        first = steps.map(lambda values: values[:, :number])
        lanes = joined_episodes(first, number)
        states = self.encoder.states_along(self._values(lanes))
        last = lanes.mask.sum(dim=-1).view(-1, 1, 1).expand(-1, 1, states.shape[-1])
        return states.gather(1, last).squeeze(1)

    def context(self, steps: Steps) -> Float[Tensor, "lanes latent"]:
        """The belief after the given trajectories."""
        return self.encoder.beliefs(self.filtered(steps)).context

    def controller(self, actor_critic: ActorCritic, steps: Steps) -> Controller:
        return BeliefController(self, actor_critic, self.filtered(steps))

    def explore(self, actor_critic: ActorCritic, trajectories: Sequence[Sequence[Trajectory]]) -> Controller:
        """The policy: it was trained to act under any belief, the prior of a first episode among them."""
        if self._config.explore == "uniform":
            return UniformController()
        with torch.no_grad():
            return self.controller(actor_critic, pad_trajectories(trajectories, self._problem))


@final
class BeliefController(FunctionController):
    """The policy's most likely actions under a belief that every step changes."""

    def __init__(
        self, learner: BorelLearner, actor_critic: ActorCritic, hidden: Float[Tensor, "lanes hidden"]
    ) -> None:
        super().__init__(self._choose, hidden.device)
        self._learner, self._actor_critic, self._hidden = learner, actor_critic, hidden

    def _choose(self, states: Float[Tensor, "lanes observation"]) -> Float[Tensor, "lanes action"]:
        return self._actor_critic.act(states, self._learner.encoder.beliefs(self._hidden).context)

    def observe(self, transition: LaneTransition) -> None:
        def tensor(values: Any) -> Tensor:
            return torch.as_tensor(values, dtype=torch.float32, device=self._hidden.device)

        with torch.no_grad():
            values = self._learner.read(
                tensor(transition.observations),
                tensor(transition.actions),
                tensor(transition.rewards),
                tensor(transition.next_observations),
            )
            active = torch.as_tensor(transition.active, device=self._hidden.device)
            self._hidden = self._learner.encoder.following(self._hidden, values, active)


def joined_episodes(steps: Steps, episodes: int) -> Steps:
    """Trajectories in groups, those of a group one after the other and their padding behind them.

    Args:
        steps: (tasks, trajectories, steps); the number of trajectories is a multiple of `episodes`.
        episodes: trajectories per group; 0 if there are none.

    Returns:
        (tasks, groups, episodes times steps).
    """
    tasks, trajectories, length = steps.mask.shape
    groups = trajectories // episodes if episodes else 1
    width = episodes * length
    mask = steps.mask.reshape(tasks, groups, width)
    order = torch.argsort((~mask).int(), dim=-1, stable=True)

    def joined(values: Tensor) -> Tensor:
        flat = values.reshape(tasks, groups, width, *values.shape[3:])
        return flat.gather(2, order.reshape(*order.shape, *[1] * (flat.ndim - 3)).expand_as(flat))

    return steps.map(joined)


@final
class Borel(Method[BorelConfig]):
    """The plug-in."""

    name = "borel"
    Config = BorelConfig
    capabilities = Capabilities(explores=True, stateful=True, needs_trajectories=False)
    search: ClassVar[Search] = {**SHARED_SEARCH, "borel.kl_weight": Factors(0.1, 10.0)}

    def batch_request(self, settings: TrainingSettings, config: BorelConfig) -> BatchRequest:
        """Whole lanes of trajectories, as many as the recipe's largest context."""
        lanes = math.ceil(max(settings.batch.context_trajectories) / config.episodes_per_belief)
        return BatchRequest(
            settings.batch.tasks, {"episodes": Trajectories(lanes * config.episodes_per_belief)}
        )

    def stages(self, settings: TrainingSettings, config: BorelConfig) -> tuple[Stage, ...]:
        request = self.batch_request(settings, config)
        steps = max(1, round(config.vae_share * settings.run.steps))
        return (
            Stage(BELIEF_STAGE, steps, request),
            Stage(POLICY_STAGE, settings.run.steps - steps, request),
        )

    def create(self, problem: Problem, settings: TrainingSettings, config: BorelConfig) -> Algorithm:
        learner = BorelLearner(problem, config, generator=problem.generator(0))
        return ContextAlgorithm(problem, settings, learner=learner)
