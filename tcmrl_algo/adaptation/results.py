"""Results of an evaluation, by test task and in the mean."""

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal

Reference = Literal["oracle", "behavior", "stored"]


@dataclass(frozen=True)
class TaskResult:
    """Result of a run on one test task; returns are undiscounted sums of rewards.

    Attributes:
        task: index of the task.
        split: `test`.
        returns: returns of the adaptation episodes, means over the repeats of the protocol.
        final: mean return of the adapted policy.
        finals: the same for every repeat; their spread is that of the protocol's own chance.
        oracle: return of a controller that knows the task, None if the environment has none.
        random: return of uniform actions, None if it was not measured.
        behavior: return of the best of the task's own behavior policies, without their noise; None if the
            dataset holds none.
        fixed: return of the best policy that acts the same in all tasks, fitted on the training tasks; None
            if there is neither an oracle nor a stored policy.
        regret: oracle - final, None without an oracle.
        normalized: (final - random) / (best - random), with `best` the return of the reference.
        reference: where `normalized` is 1: the `oracle` or, without one, `behavior`, or without that one
            too the best policy's `stored` episodes.
        success: share of successful final episodes, None if the environment does not define success.
        shuffled: mean return of the same policy with the contexts of other tasks. A policy that adapts
            within an episode starts with the belief of the other task and updates it by its observations,
            so the value measures how well it corrects a wrong belief. A privileged policy keeps the
            parameters of the task itself.
    """

    task: int
    split: str
    returns: list[float]
    final: float
    finals: list[float]
    oracle: float | None
    random: float | None
    behavior: float | None
    fixed: float | None
    regret: float | None
    normalized: float | None
    reference: Reference
    success: float | None
    shuffled: float


@dataclass(frozen=True)
class Evaluation:
    """Result of a run on all test tasks; means are over tasks, and None if a task has no value.

    Attributes:
        algorithm, environment, seed, protocol: which evaluation this is.
        repeats: how many times the protocol was run; 1 unless its first stage is random.
        tasks: results by test task.
        adaptation_curve: mean returns of the first, second, … adaptation episode: how many episodes it
            takes until the policy is adapted. The episodes are those of the protocol; under `paper` the
            first ones are the method's exploration, uniform actions unless it has one of its own.
        mean_final, mean_regret, mean_normalized, mean_shuffled, mean_behavior, mean_fixed: means of the
            tasks' values.
        privileged: whether the method is a control that observes the task parameters.
    """

    algorithm: str
    environment: str
    seed: int
    protocol: str
    repeats: int
    tasks: list[TaskResult]
    adaptation_curve: list[float]
    mean_final: float
    mean_regret: float | None
    mean_normalized: float | None
    mean_shuffled: float
    mean_behavior: float | None
    mean_fixed: float | None
    privileged: bool

    def to_json(self) -> dict[str, Any]:
        """The JSON document of `tcmrl evaluate --json`."""
        return dataclasses.asdict(self)
