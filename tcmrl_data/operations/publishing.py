"""What a worker does that makes parts from stored ones. Idempotent: published parts are left alone."""

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tcmrl_data.behavior.snapshot import Snapshot
from tcmrl_data.building.part import check_finite
from tcmrl_data.building.plan import BuildPlan
from tcmrl_data.building.published import Published, read_published
from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.engine.worker import Send
from tcmrl_data.envs.base import Lanes
from tcmrl_data.envs.tasks import Task
from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.foundation.canonical import digest
from tcmrl_data.foundation.disk import STAGING, replace_file
from tcmrl_data.foundation.errors import ManifestError, StoreError
from tcmrl_data.operations.derived import derived_fields
from tcmrl_data.operations.extension import Extension, extended_episodes
from tcmrl_data.operations.relabelling import RELABEL, Relabelling, relabelled_episodes
from tcmrl_data.operations.remaking import Job, RemakeSpec
from tcmrl_data.recipe.recipe import same_settings
from tcmrl_data.store.keys import part_file
from tcmrl_data.store.part_making import NO_REFERENCES, make_part
from tcmrl_data.store.part_record import Identity, PartRecord, References
from tcmrl_data.store.part_table import REFERENCES


def publish_parts(spec: RemakeSpec, report: Send) -> str:
    """Makes every missing part of the jobs.

    Args:
        spec: what to make.
        report: receives a message per part.

    Returns:
        A digest over the ids of the parts.

    Raises:
        StoreError: another part lies where one is to be.
    """
    dataset = open_dataset(spec.source)
    ids = []
    for task in sorted({job.key.task for job in spec.jobs}):
        with contextlib.closing(_Maker(dataset, spec, dataset.task(task))) as maker:
            for job in spec.jobs:
                if job.key.task == task:
                    published = maker.publish(job)
                    report(published.to_message())
                    ids.append(published.entry.id)
    return digest(ids)


class _Maker:
    """Makes the parts of one task, with one set of lanes."""

    def __init__(self, dataset: Dataset, spec: RemakeSpec, task: Task) -> None:
        self._dataset, self._spec, self._task = dataset, spec, task
        self._plan = BuildPlan.of_tasks(spec.recipe, seed=spec.seed, tasks=[task])
        self._lanes: Lanes | None = None

    def close(self) -> None:
        """Frees the lanes."""
        if self._lanes is not None:
            self._lanes.close()

    def publish(self, job: Job) -> Published:
        """Publishes the part of a job; a sound one that is there is read and left alone."""
        file = self._spec.out / part_file(job.key)
        source = self._dataset.part(*job.source)
        settings = self._settings(job)
        derived = derived_fields(self._spec.operation, [source.id], settings)
        found = _read(file, job.key.run)
        if found is not None:
            published, record = found
            if not self._is_wanted(record.identity, source.identity.policy, derived):
                raise StoreError(f"{file}: holds another part; delete it or choose another --run")
            return published
        snapshot = None if source.identity.policy is None else self._dataset.snapshot(*job.source)
        trajectories = self._episodes(job, snapshot, settings)
        check_finite(trajectories, f"{self._plan.environment.name}, {job.key}")
        record, data = make_part(
            settings=self._spec.recipe.unit_settings(),
            task=self._task,
            step=job.key.step,
            seed=self._spec.seed,
            snapshot=snapshot,
            trajectories=trajectories,
            references=self._references(),
            behavior=source.behavior,
            platform=self._plan.platform,
            derived=derived,
        )
        replace_file(file, data, staging=self._spec.out / STAGING)
        return Published.of_record(record, run=job.key.run, archive=data)

    def _settings(self, job: Job) -> Extension | Relabelling:
        """The settings of a job's part."""
        if self._spec.operation == RELABEL:
            return Relabelling(task=job.source.task, **self._spec.settings)
        parameters = dict(self._dataset.task(job.source.task).parameters)
        return Extension(task=job.source.task, parameters=parameters, **self._spec.settings)

    def _episodes(
        self, job: Job, snapshot: Snapshot | None, settings: Extension | Relabelling
    ) -> list[Trajectory]:
        """The episodes of a job's part."""
        if isinstance(settings, Extension):
            assert snapshot is not None  # the driver saw to it
            return extended_episodes(self._plan, snapshot, settings, self._open_lanes())
        return relabelled_episodes(
            self._plan.environment,
            self._dataset.trajectories(*job.source),
            settings=settings,
            step=job.source.step,
            seed=self._spec.seed,
            target=self._task,
            lanes=self._open_lanes(),
        )

    def _open_lanes(self) -> Lanes:
        if self._lanes is None:
            lanes = self._spec.recipe.rollouts.lanes
            self._lanes = self._plan.environment.lanes([self._task.parameters] * lanes)
        return self._lanes

    def _is_wanted(self, identity: Identity, policy: str | None, derived: Mapping[str, Any]) -> bool:
        """Whether a part that is there is the one of a job."""
        found = (identity.derived, identity.policy, identity.seed, identity.parameters)
        wanted = (derived, policy, self._spec.seed, self._task.parameters)
        return found == wanted and same_settings(identity.settings, self._spec.recipe.unit_settings())

    def _references(self) -> References:
        """Those that the dataset has for the task."""
        entries = self._dataset.parts.entries_of(self._task.index)
        if not entries:
            return NO_REFERENCES
        return References(**{name: getattr(entries[0], name) for name in REFERENCES})


def _read(file: Path, run: str) -> tuple[Published, PartRecord] | None:
    """The part that is there; None if there is none, or a damaged one."""
    if not file.exists():
        return None
    try:
        return read_published(file, run)
    except (StoreError, ManifestError):
        return None
