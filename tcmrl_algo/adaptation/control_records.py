"""What is recorded of the controls of a dataset."""

from statistics import fmean
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class FixedSnapshot(_Record):
    """The training task's last policy that does best in all training tasks.

    Attributes:
        task, step, run: the part that holds the policy.
        train_return: mean over the training tasks.
        train_returns: mean of every candidate that was tried in all of them, by the candidate's task.
        average_return: mean over all candidates, in the training tasks in which all were tried: what the
            choice of the best is worth, for which candidates act in the tasks.
    """

    task: int
    step: int
    run: str
    train_return: float
    train_returns: dict[int, float]
    average_return: float


class FixedTarget(_Record):
    """The task parameters whose oracle does best in all training tasks.

    Attributes:
        parameters: of no task in particular.
        train_return: mean over the training tasks.
    """

    parameters: dict[str, Any]
    train_return: float


class TaskControls(_Record):
    """Returns in one test task, all undiscounted means; None for what the environment or dataset lacks.

    Attributes:
        task: index of the task.
        uniform: of uniform actions.
        oracle: of a controller that knows the task.
        behavior: of the best of the task's own behavior policies, without their noise.
        behavior_step: training step of that policy.
        fixed_snapshot, fixed_target: of the fixed policies of these names.
        fixed: of the one of the two that does better in the training tasks.
    """

    task: int
    uniform: float | None
    oracle: float | None
    behavior: float | None
    behavior_step: int | None
    fixed_snapshot: float | None
    fixed_target: float | None
    fixed: float | None


class Controls(_Record):
    """What adaptation is compared with on a dataset; the document of `tcmrl controls --json`.

    The fixed policies are fitted on the training tasks and act the same in every task. A behavior policy that
    observes what the stored view hides keeps the values of its own task.

    Attributes:
        environment, dataset_root: which dataset this is.
        splits: split by task.
        versions: of the packages that the returns depend on.
        fingerprint: of the environment.
        fixed_snapshot, fixed_target: the fixed policies; None where there are no stored policies or no
            oracle.
        tasks: the test tasks.
    """

    schema_version: Literal[2] = 2
    environment: str
    dataset_root: str
    splits: dict[int, str]
    versions: dict[str, str]
    fingerprint: dict[str, Any]
    fixed_snapshot: FixedSnapshot | None = None
    fixed_target: FixedTarget | None = None
    tasks: tuple[TaskControls, ...] = ()

    def task(self, index: int) -> TaskControls:
        """The controls of one test task."""
        (found,) = (task for task in self.tasks if task.task == index)
        return found

    def mean(self, name: str) -> float | None:
        """Mean over the test tasks of the returns called `name`; None if a task has none."""
        values = [getattr(task, name) for task in self.tasks]
        return None if None in values or not values else fmean(values)
