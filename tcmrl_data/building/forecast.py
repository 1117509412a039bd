"""What a build takes: tasks, parts, environment steps, bytes, and a time measured by a short probe."""

from dataclasses import dataclass

from tcmrl_data.building.duration import estimate_duration
from tcmrl_data.building.plan import BuildPlan
from tcmrl_data.foundation.machine import available_cores


@dataclass(frozen=True)
class Forecast:
    """A build before it starts.

    Attributes:
        training_steps: environment steps of behavior training, all tasks together.
        rollout_steps: stored environment steps, at most; episodes may end early.
        bytes: size of the arrays before compression, an upper bound.
        unit_bytes: most memory that a worker takes.
        seconds: expected wall time with `workers` processes on this machine.
        seconds_low: the short end of its spread.
        seconds_high: the long end.
    """

    environment: str
    profile: str
    behavior: str
    tasks: int
    train: int
    test: int
    snapshots: int
    parts: int
    episodes: int
    training_steps: int
    rollout_steps: int
    bytes: int
    workers: int
    unit_bytes: int
    seconds: float
    seconds_low: float
    seconds_high: float


def forecast_build(plan: BuildPlan, *, workers: int | None = None) -> Forecast:
    """What a build takes, from its plan and from a few seconds of measuring this machine.

    Args:
        plan: of the build.
        workers: processes at a time; one per core where None.
    """
    recipe, environment, source, chosen = plan.recipe, plan.environment, plan.source, plan.tasks
    workers = workers or available_cores()
    episodes, horizon = recipe.rollouts.episodes, environment.settings.horizon
    parts = len(chosen) * len(source.steps)
    largest = max(plan.groups, key=len)
    duration = estimate_duration(plan, workers)
    return Forecast(
        environment=environment.name,
        profile=recipe.profile,
        behavior=recipe.behavior.source,
        tasks=len(chosen),
        train=sum(task.split == "train" for task in chosen),
        test=sum(task.split == "test" for task in chosen),
        snapshots=len(source.steps),
        parts=parts,
        episodes=parts * episodes,
        training_steps=len(chosen) * source.training_steps,
        rollout_steps=parts * episodes * horizon,
        bytes=parts * plan.part_bytes,
        workers=workers,
        unit_bytes=plan.unit_bytes(len(largest)),
        seconds=duration.seconds,
        seconds_low=duration.seconds_low,
        seconds_high=duration.seconds_high,
    )
