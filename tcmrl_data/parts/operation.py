"""Operations: how the episodes of a part come about, the first time and every time that they are made again.

A part is a function of its identity. `Identity.derived` names the operation and its settings; a part without
it is a rollout, or was imported. Build, derive, extend and relabel make parts by their operation; replay,
verify and repair make them again by the same one.
"""

import abc
import functools
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar, final

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel

from tcmrl_data.behavior.base import Snapshot, read_snapshot
from tcmrl_data.envs.base import Environment, Lanes, Task
from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.errors import BuildError, RenderingError, StoreError, TrajectoryError
from tcmrl_data.foundation.plugins import Registry
from tcmrl_data.recipe.recipe import Recipe
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.arrays import read_arrays, unpack
from tcmrl_data.store.manifest import FOREIGN_KINDS, Run, RunKind
from tcmrl_data.store.part import DATA_VERSION, PartRecord, Platform, this_platform
from tcmrl_data.store.tables import PartKey

if TYPE_CHECKING:
    from tcmrl_data.dataset.dataset import Dataset

OperationSettings = TypeVar("OperationSettings", bound=BaseModel)


@dataclass(frozen=True)
class WantedPart:
    """The identity of a part whose episodes are still to be made.

    Attributes:
        settings: the unit settings of the run's recipe.
        seed: root seed of the run; None where it is not known.
        snapshot: the policy; None where it is not known.
        derived: how the part is made from others: `operation`, `from` (ids of parts) and `settings`.
        data_version: of the code that makes the episodes.
    """

    settings: Mapping[str, Any]
    task: Task
    step: int
    seed: int | None = None
    snapshot: Snapshot | None = None
    derived: Mapping[str, Any] | None = None
    data_version: int = DATA_VERSION


@dataclass(frozen=True)
class StoredPart:
    """A part that lies in a dataset or an archive; its arrays are read when they are asked for.

    Attributes:
        snapshot: the policy; None where it is not known.
        first: number of the first episodes that are read; all where None.
    """

    record: PartRecord
    place: str
    read: Callable[[Iterable[str]], Mapping[str, npt.NDArray[Any]]]
    snapshot: Snapshot | None
    task: Task
    first: int | None = None

    @classmethod
    def of(cls, dataset: "Dataset", key: PartKey) -> "StoredPart":
        """A part of a dataset, whose bytes are those of the table.

        Raises:
            StoreError: the part is damaged: what is made of it would not be.
        """
        dataset.content(key)
        record = dataset.part(*key)
        snapshot = None if record.identity.policy is None else dataset.snapshot(*key)
        return cls(
            record,
            str(dataset.file_of(key)),
            lambda names: dataset.arrays(*key, names=names),
            snapshot,
            dataset.task(key.task),
        )

    @classmethod
    def in_archive(cls, archive: Archive, record: PartRecord) -> "StoredPart":
        """A part in an archive that stays open while it is used."""
        identity, place = record.identity, str(archive.path)
        policy = identity.policy
        snapshot = None if policy is None else read_snapshot(archive.read, identity.step, place=place)
        task = Task(identity.task, "train", identity.parameters)  # no episode depends on the split
        return cls(record, place, functools.partial(read_arrays, archive), snapshot, task)

    def wanted(self) -> WantedPart:
        """Its identity but for its arrays, from which it can be made again."""
        identity = self.record.identity
        return WantedPart(
            settings=identity.settings,
            task=self.task,
            step=identity.step,
            seed=identity.seed,
            snapshot=self.snapshot,
            derived=identity.derived,
            data_version=identity.data_version,
        )

    def episodes(self, *, without: Collection[str] = ()) -> list[Trajectory]:
        """The episodes, without some of their extra arrays.

        Raises:
            StoreError: arrays that do not decode or do not form episodes.
        """
        arrays = self.read([name for name in self.record.identity.arrays if name not in without])
        try:
            return unpack(arrays)[: self.first]
        except (StoreError, TrajectoryError) as error:
            raise StoreError(f"{self.place}: {error}; run `tcmrl-data verify --repair`") from None


@final
class Simulator:
    """The simulator of one task; its lanes are made when they are first used.

    Args:
        recipe: says how many episodes and lanes a part has.
        environment: the recipe's, where it is made already.
        platform: of this process for the recipe, where it is known already.
    """

    def __init__(
        self,
        recipe: Recipe,
        *,
        seed: int,
        task: Task,
        environment: Environment | None = None,
        platform: Platform | None = None,
        num_lanes: int | None = None,
    ) -> None:
        self.recipe, self.seed, self.task = recipe, seed, task
        self.environment = environment or recipe.make_environment()
        self.num_lanes = num_lanes or recipe.rollouts.lanes
        self._platform, self._lanes = platform, None  # type: Platform | None, Lanes | None

    @property
    def platform(self) -> Platform:
        """The platform of this process for the environment and the behavior source."""
        if self._platform is None:
            self._platform = this_platform(self.environment, self.recipe.behavior.source)
        return self._platform

    @property
    def lanes(self) -> Lanes:
        """Lanes of the task, which several rollouts use one after the other."""
        if self._lanes is None:
            self._lanes = self.environment.lanes([self.task.parameters] * self.num_lanes)
        return self._lanes

    def close(self) -> None:
        """Frees the lanes; they are made again when they are used again."""
        if self._lanes is not None:
            self._lanes.close()
            self._lanes = None


class MissingSourceError(BuildError):
    """A part cannot be made again, since the one that it was made from is not at hand."""


@dataclass(frozen=True)
class Sources:
    """What the episodes of a part may be made from, beside its identity.

    Attributes:
        simulator: of the part's task; None where the operation does not simulate.
        parts: the stored parts that `derived` names under `from`, in their order.
    """

    simulator: Simulator | None = None
    parts: Sequence[StoredPart] = ()

    @property
    def running(self) -> Simulator:
        """The simulator, for operations that simulate."""
        assert self.simulator is not None
        return self.simulator

    @property
    def part(self) -> StoredPart:
        """The one part that another is made from; raises `MissingSourceError` where it is not at hand."""
        if not self.parts:
            raise MissingSourceError("the part that it was made from is not in this dataset")
        return self.parts[0]


class Operation(abc.ABC, Generic[OperationSettings]):
    """How the episodes of a part come about; a plug-in of the entry point group `tcmrl.operations`.

    Equal identities and sources give equal episodes, bit for bit: random numbers come from
    `foundation.seeding.keyed_generator`, keyed by the wanted part's seed, task and step.

    Example:
        >>> class EverySecond(Operation[Record]):
        ...     name = "every-second"
        ...     Settings = Record
        ...
        ...     def episodes(self, wanted, sources):
        ...         return sources.part.episodes()[::2]
    """

    name: ClassVar[str]
    Settings: ClassVar[type[BaseModel]]
    """Class of `derived.settings`; its JSON form is part of the identity, so changing it changes ids."""
    kinds: ClassVar[tuple[RunKind, ...]] = ()
    """Kinds of runs that hold parts of the operation, where these have kinds of their own."""
    simulates: ClassVar[bool] = False
    """Whether the episodes come from the simulator. The parts of operations that do not simulate keep seed,
    platform and reference returns of the part that they are made from."""
    keeps: ClassVar[tuple[str, ...]] = ()
    """Names of the arrays that the operation copies unchanged from its source. If it copies observations and
    actions, `verify` makes a part whose source is missing again from the part itself."""
    own_seeds: ClassVar[bool] = False
    """Whether episodes are reset with keyed seeds of the part's own task, so that further ones can follow."""
    example: ClassVar[Mapping[str, Any]] = {}
    """Settings with which the contract test makes a part."""

    def __init__(self, settings: OperationSettings) -> None:
        self.settings = settings

    @abc.abstractmethod
    def episodes(self, wanted: WantedPart, sources: Sources) -> list[Trajectory]:
        """The episodes of a part, at least one.

        Raises:
            TcmrlError: they cannot be made; nothing is published.
        """

    @classmethod
    def settings_for(cls, settings: Mapping[str, Any], source: Task) -> Mapping[str, Any]:
        """The settings of one part.

        Args:
            settings: what the parts of a run have in common.
            source: task of the part that it is made from.
        """
        return settings

    @classmethod
    def settings_of(cls, run: Run, source: Run) -> Mapping[str, Any]:
        """What the settings of a run's parts have in common, as the manifest says.

        Args:
            source: of the parts that they are made from.
        """
        settings: Mapping[str, Any] = (run.origin or {}).get("settings", {})
        return settings

    def derived(self, source: PartRecord) -> dict[str, Any] | None:
        """What the identity says of how the part is made from another; None for one made from none."""
        settings = self.settings.model_dump(mode="json")
        return {"operation": self.name, "from": [source.id], "settings": settings}

    def seeded_as(self, task: int, number: int, run: Run) -> tuple[int, int]:
        """The task and the number in the key of the seed with which an episode was reset.

        Args:
            number: position of the episode in the part.

        Raises:
            RenderingError: the operation does not say.
        """
        raise RenderingError(f"operation {self.name} does not say from where its episodes started")

    def make(self, wanted: WantedPart, sources: Sources) -> list[Trajectory]:
        """The episodes, which are finite.

        Raises:
            BuildError: values that are not finite; names the episode, the array and the step.
        """
        episodes = self.episodes(wanted, sources)
        check_finite(episodes, f"task {wanted.task.index}, snapshot step {wanted.step}")
        return episodes


OPERATIONS: Registry[Operation[Any]] = Registry("tcmrl.operations", "operation", Operation)
"""Operations of other packages; `operations_by_name` knows those of this package too."""


def can_be_made_again(run: Run) -> bool:
    """Whether the parts of a run follow from what a dataset can hold; foreign and cut episodes do not."""
    return run.recipe is not None and run.kind not in (*FOREIGN_KINDS, "subset")


def check_finite(trajectories: Sequence[Trajectory], place: str) -> None:
    """Refuses episodes with values that are not finite."""
    for episode, trajectory in enumerate(trajectories):
        for name in ("rewards", "observations", "actions"):
            array = getattr(trajectory, name)
            rows = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))
            if len(rows):
                raise BuildError(
                    f"{place}, episode {episode}: {name} are not finite at step {rows[0]} "
                    f"({array[rows[0]]}); mend the environment"
                )
