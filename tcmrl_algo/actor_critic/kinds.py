"""The actor-critic that the settings name."""

import torch

from tcmrl_algo.actor_critic.actor_critic import ActorCritic
from tcmrl_algo.actor_critic.bc import BehaviorCloning
from tcmrl_algo.actor_critic.iql import ImplicitQLearning
from tcmrl_algo.actor_critic.sac import SoftActorCritic
from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.settings.actor_critic import ActorCriticSettings

Kind = type[SoftActorCritic] | type[ImplicitQLearning] | type[BehaviorCloning]
KINDS: dict[str, Kind] = {"sac": SoftActorCritic, "iql": ImplicitQLearning, "bc": BehaviorCloning}


def make_actor_critic(
    settings: ActorCriticSettings, problem: Problem, *, latent: int, generator: torch.Generator
) -> ActorCritic:
    """A new actor-critic of `settings.kind`.

    Args:
        settings: the resolved table.
        problem: sizes and moments of the data.
        latent: size of the context; 0 makes everything blind to the task.
        generator: draws the starts.
    """
    return KINDS[settings.kind](settings, problem, latent=latent, generator=generator)
