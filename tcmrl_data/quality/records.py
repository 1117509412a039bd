"""Records of what was measured of a dataset; commands, reports and cards print them.

A number is None where it is not defined: a score without reference returns, a ratio of two zeros.
"""

from typing import Any

from tcmrl_data.dataset.tables import Tables
from tcmrl_data.dataset.tiers import Tier
from tcmrl_data.envs.tasks import Split
from tcmrl_data.foundation.records import Record


class Measured(Record):
    """What every record begins with.

    Attributes:
        label: the dataset's own name, if it has one.
        environment: the environment's name.
        root: of the dataset; equal data have an equal root.
    """

    label: str | None
    environment: str
    root: str


class Spread(Record):
    """A quantity over several tasks.

    Attributes:
        mean: of all.
        iqm: interquartile mean, without the lowest and the highest quarter.
        low: lower end of the 95% bootstrap interval of `iqm`; None with fewer than five values.
        high: upper end.
        min: smallest value.
        max: largest value.
    """

    mean: float
    iqm: float
    low: float | None
    high: float | None
    min: float
    max: float


class SnapshotQuality(Record):
    """The quality of a part.

    Attributes:
        step: training steps of its policy.
        run: name of its run.
        episodes: number of episodes.
        mean: mean undiscounted return.
        tq: trajectory quality: 0 is as good as uniform actions, 1 as the best that is known of the task.
        tiers: the quality tiers that take the part.
    """

    step: int
    run: str
    episodes: int
    mean: float
    tq: float | None
    tiers: tuple[Tier, ...]


class TaskQuality(Record):
    """The parts of a task, ascending by step and run."""

    task: int
    split: Split
    snapshots: tuple[SnapshotQuality, ...]


class StageQuality(Record):
    """The parts of one step and split.

    Attributes:
        step: training steps of the policies.
        split: of the tasks.
        parts: number of parts.
        tq: over these parts; None where a part has none.
    """

    step: int
    split: Split
    parts: int
    tq: Spread | None


class Quality(Measured):
    """Trajectory quality and tiers of all parts: the document of `inspect quality --json`."""

    stages: tuple[StageQuality, ...]
    tasks: tuple[TaskQuality, ...]


class SnapshotCoverage(Record):
    """The coverage of a part.

    Attributes:
        step: training steps of its policy.
        run: name of its run.
        steps: number of environment steps.
        cells: number of different state-action cells.
        saco: `cells` as a share of the cells of all parts of the task.
        tq: trajectory quality, as in `SnapshotQuality`.
    """

    step: int
    run: str
    steps: int
    cells: int
    saco: float
    tq: float | None


class TaskCoverage(Record):
    """The parts of a task, ascending by step and run; `cells` counts those of all parts together."""

    task: int
    split: Split
    cells: int
    snapshots: tuple[SnapshotCoverage, ...]


class StageCoverage(Record):
    """Means over the parts of one step and split."""

    step: int
    split: Split
    parts: int
    steps: float
    cells: float
    saco: float
    tq: float | None


class Overlap(Record):
    """How far tasks visit the same states.

    Attributes:
        tasks: indices of tasks, evenly spread over the dataset's.
        shares: row i, column j: share of the state cells of task `tasks[i]` that task `tasks[j]` visits too.
    """

    tasks: tuple[int, ...]
    shares: tuple[tuple[float, ...], ...]


class Coverage(Measured):
    """State-action coverage of all parts: the document of `inspect coverage --json`.

    Attributes:
        cell: width of a cell in standard deviations of each column.
        columns: number of observation and action columns that vary; the grid has as many dimensions.
        stages: means by step and split.
        tasks: every part.
        overlap: of the states that tasks visit.
    """

    cell: float
    columns: int
    stages: tuple[StageCoverage, ...]
    tasks: tuple[TaskCoverage, ...]
    overlap: Overlap


class SnapshotRewards(Record):
    """The stored rewards of a part.

    Attributes:
        step: training steps of its policy.
        run: name of its run.
        steps: number of rewards.
        zero: share of rewards that are exactly zero.
        silent: share of episodes in which all rewards are zero.
        mean: of the rewards.
        std: of the rewards, the population's.
        min: smallest reward.
        max: largest reward.
    """

    step: int
    run: str
    steps: int
    zero: float
    silent: float
    mean: float
    std: float
    min: float
    max: float


class TaskRewards(Record):
    """The parts of a task, ascending by step and run."""

    task: int
    split: Split
    snapshots: tuple[SnapshotRewards, ...]


class StageRewards(Record):
    """The rewards of one step and split; `zero`, `silent`, `mean` are means over its parts.

    Attributes:
        step: training steps of the policies.
        split: of the tasks.
        parts: number of parts.
        steps: number of rewards.
        zero: as in `SnapshotRewards`; `silent` and `mean` likewise.
        min: smallest reward.
        max: largest reward.
        counts: number of rewards in every bin.
    """

    step: int
    split: Split
    parts: int
    steps: int
    zero: float
    silent: float
    mean: float
    min: float
    max: float
    counts: tuple[int, ...]


class Rewards(Measured):
    """Stored rewards of all parts: the document of `inspect rewards --json`.

    Attributes:
        edges: borders of the bins, one more than bins. The first and the last bin also count what lies
            beyond, because the borders come from a sample of the parts.
        stages: by step and split.
        tasks: every part.
    """

    edges: tuple[float, ...]
    stages: tuple[StageRewards, ...]
    tasks: tuple[TaskRewards, ...]


class TransferTask(Record):
    """A row and a column of the matrix: a task and its last policy.

    Attributes:
        task: index.
        split: of the task.
        step: training steps of its policy.
        run: the run that the policy is from.
        uniform: mean return of uniform actions in the task, if it is known.
        best: the best return that is known of the task: of the oracle, else the scripted expert, else its
            best snapshot.
    """

    task: int
    split: Split
    step: int
    run: str
    uniform: float | None
    best: float


class Transfer(Measured):
    """Every last policy in every task: the document of `inspect transfer --json`.

    Attributes:
        seed: of the episodes.
        episodes: of a policy in a task.
        deterministic: whether policies act without their noise.
        left_out: number of the dataset's tasks that take no part, because they are incomplete or too many.
        tasks: rows and columns, training tasks first.
        returns: row i, column j: mean return of the policy of task i in task j.
        scores: the same in units of `tq`; None where the task has no references.
    """

    seed: int
    episodes: int
    deterministic: bool
    left_out: int
    tasks: tuple[TransferTask, ...]
    returns: tuple[tuple[float, ...], ...]
    scores: tuple[tuple[float | None, ...], ...]


class SplitWorth(Record):
    """What a context is worth in the tasks of a split.

    Attributes:
        split: of the tasks.
        tasks: number of tasks.
        own: mean return of the tasks' own policies.
        single: mean return in these tasks of the best single policy, which is the same in both splits.
        uniform: mean return of uniform actions.
        best: mean of the best returns that are known of the tasks.
        worth: (own − single) / (best − uniform).
        low: lower end of the 95% bootstrap interval of `worth` over tasks; None with fewer than five.
        high: upper end.
    """

    split: Split
    tasks: int
    own: float
    single: float
    uniform: float | None
    best: float
    worth: float | None
    low: float | None
    high: float | None


class StageVisibility(Record):
    """How visible the task is in the data of one step and split.

    Attributes:
        step: training steps of the policies.
        split: of the tasks.
        tasks: number of tasks.
        rewarded: share of steps with a reward other than zero.
        reward: visibility in rewards: 1 − (squared error of predictions from the same task) / (from other
            tasks). 1 is plain to see, 0 is invisible; None where rewards cannot be told apart at all.
        dynamics: visibility in the changes of observations.
    """

    step: int
    split: Split
    tasks: int
    rewarded: float
    reward: float | None
    dynamics: float | None


class Worth(Measured):
    """Whether a context is worth having: the document of `inspect worth --json`.

    Attributes:
        seed: of episodes and samples.
        episodes: of a policy in a task.
        transitions: most transitions of a part that are predicted, and that predict.
        neighbours: nearest neighbours of a prediction.
        left_out: number of tasks that take no part.
        single_task: the training task whose policy does best in all training tasks.
        splits: what a context is worth.
        stages: how visible the task is.
    """

    seed: int
    episodes: int
    transitions: int
    neighbours: int
    left_out: int
    single_task: int
    splits: tuple[SplitWorth, ...]
    stages: tuple[StageVisibility, ...]


def heading(dataset: Tables) -> dict[str, Any]:
    """What a record of the dataset begins with."""
    manifest = dataset.manifest
    return {"label": manifest.label, "environment": manifest.name, "root": manifest.root}
