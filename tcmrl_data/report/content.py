"""Everything that a report shows, measured of a dataset with one part in memory at a time."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.dataset.listing import dataset_summary
from tcmrl_data.dataset.returns import return_table, task_table
from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.quality.coverage import Coverage, measure_coverage
from tcmrl_data.quality.rewards import Rewards, measure_rewards
from tcmrl_data.quality.scores import Quality, measure_quality
from tcmrl_data.quality.transfer import Transfer, measure_transfer
from tcmrl_data.report.evenly import evenly
from tcmrl_data.report.excerpts import Browsed, Paths, browse
from tcmrl_data.report.measures import Actions, Episodes, Visits
from tcmrl_data.report.plane import Plane, choose_plane
from tcmrl_data.report.strips import Strips, film_strips
from tcmrl_data.store.part import STANDARD_ARRAYS

SHOWN_TASKS = 100
"""Tasks with a map of visits, paths and a learning curve; of more tasks, evenly chosen ones."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Content:
    """What was read and measured of a dataset.

    Attributes:
        dataset: the dataset.
        summary: of `dataset_summary`.
        returns: the document of `inspect returns --json`.
        tasks: the document of `inspect tasks --json`.
        shown: tasks that are drawn one by one.
        plane: in which states are drawn.
        quality: the record of `inspect quality --json`.
        coverage: the record of `inspect coverage --json`.
        rewards: the record of `inspect rewards --json`.
        visits: states of the shown tasks.
        actions: of all parts.
        episodes: of all parts.
        paths: of the first, the middle and the last snapshot of the shown tasks.
        browsed: whole episodes.
        transfer: the record of `inspect transfer --json`, if policies were to play in other tasks.
        strips: pictures of episodes, if there were to be any.
    """

    dataset: Dataset
    summary: dict[str, Any]
    returns: dict[str, Any]
    tasks: dict[str, Any]
    shown: tuple[Task, ...]
    plane: Plane
    quality: Quality
    coverage: Coverage
    rewards: Rewards
    visits: Visits
    actions: Actions
    episodes: Episodes
    paths: Paths
    browsed: list[Browsed]
    transfer: Transfer | None = None
    strips: Strips | None = None


def measure(
    dataset: Dataset, *, browsed: int, transfer: bool = False, strips: int = 0, progress: Progress
) -> Content:
    """Reads a dataset part by part.

    Args:
        dataset: the dataset; of an incomplete one, what is there.
        browsed: number of whole episodes to keep.
        transfer: let every last policy play in every task.
        strips: number of episodes to simulate again for pictures.
        progress: called with the stage, the amount done and the total; every part is read three times.

    Raises:
        SelectionError: it has no parts, or too few tasks for `transfer`.
        SnapshotError: a policy for `transfer` is missing.
        StoreError: a part is missing or damaged.
    """
    entries = [entry for task in dataset.tasks for entry in dataset.parts.entries_of(task.index)]
    if not entries:
        raise SelectionError(f"{dataset.path} has no parts to report; build it with `tcmrl-data build`")
    keys = [entry.key for entry in entries]
    shown = evenly([task for task in dataset.tasks if dataset.parts.keys_of(task.index)], SHOWN_TASKS)
    plane = choose_plane(dataset, keys)
    visits = Visits(plane, [task.index for task in shown])
    actions = Actions()
    episodes = Episodes(min(entry.min for entry in entries), max(entry.max for entry in entries))
    paths = Paths(plane, [key for task in shown for key in evenly(dataset.parts.keys_of(task.index), 3)])
    for done, key in enumerate(keys, start=1):
        arrays = dataset.arrays(*key, names=STANDARD_ARRAYS)
        for measured in (visits, actions, episodes, paths):
            measured.add(key, arrays)
        progress("reading", done, 3 * len(keys))
    return Content(
        dataset,
        dataset_summary(dataset),
        return_table(dataset),
        task_table(dataset),
        shown,
        plane,
        measure_quality(dataset),
        measure_coverage(dataset, progress=lambda done, total: progress("reading", total + done, 3 * total)),
        measure_rewards(
            dataset, progress=lambda done, total: progress("reading", 2 * total + done, 3 * total)
        ),
        visits,
        actions,
        episodes,
        paths,
        browse(dataset, keys, browsed),
        measure_transfer(dataset, progress=lambda done, total: progress("playing", done, total))
        if transfer
        else None,
        film_strips(dataset, shown, strips, progress=lambda done, total: progress("filming", done, total))
        if strips
        else None,
    )
