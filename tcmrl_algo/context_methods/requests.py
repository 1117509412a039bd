"""What batches hold for methods that adapt through a context."""

from tcmrl_algo.settings.training import TrainingSettings
from tcmrl_data import BatchRequest, Trajectories, Transitions


def policy_transitions(settings: TrainingSettings) -> Transitions:
    """The transitions, with the rewards, that the shared actor-critic learns from."""
    return Transitions(settings.batch.transitions, rewards=settings.actor_critic.rewards)


def trajectory_request(settings: TrainingSettings) -> BatchRequest:
    """The `[training.batch]` table without windows: transitions, and two disjoint groups of trajectories."""
    batch = settings.batch
    return BatchRequest(
        batch.tasks,
        {
            "policy": policy_transitions(settings),
            "context": Trajectories(batch.context_trajectories),
            "execution": Trajectories(batch.execution_trajectories, apart_from="context"),
        },
    )
