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
from typing import Any, ClassVar, final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tcmrl_algo.actor_critic.actor_critic import ActorCritic
from tcmrl_algo.algorithms.borel.belief import BeliefDecoder, BeliefEncoder, Beliefs, StepReader, StepValues
from tcmrl_algo.algorithms.borel.config import BorelConfig
from tcmrl_algo.context_methods.learner import ContextAlgorithm, ContextLearner, ContextLosses
from tcmrl_algo.losses.beliefs import belief_divergence, belief_reconstruction
from tcmrl_algo.methods.base import Algorithm, Capabilities, Method
from tcmrl_algo.methods.network_algorithm import FunctionController
from tcmrl_algo.methods.padding import pad_trajectories
from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.methods.search import SHARED_SEARCH, Factors, Search
from tcmrl_algo.methods.stages import Stage
from tcmrl_algo.settings.training import TrainingSettings
from tcmrl_data import (
    Batch,
    BatchRequest,
    Controller,
    Steps,
    Trajectories,
    Trajectory,
    Transition,
    UniformController,
)

BELIEF_STAGE, POLICY_STAGE = "belief", "policy"


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

    def observe(self, transition: Transition) -> None:
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
