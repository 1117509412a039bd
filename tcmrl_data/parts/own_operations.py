"""The operations of this package: rollout, extend, relabel, cut and import."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar, final

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationError

from tcmrl_data.behavior.base import Snapshot
from tcmrl_data.envs.base import Task
from tcmrl_data.envs.rollout import (
    Controller,
    NoisyController,
    PlaybackController,
    Trajectory,
    UniformController,
    roll_out,
)
from tcmrl_data.foundation.errors import BuildError, ManifestError, SelectionError, SimulationError
from tcmrl_data.foundation.records import (
    Record,
    as_model,
    count_ranges,
    first_problem,
    read_ranges,
    write_ranges,
)
from tcmrl_data.foundation.seeding import Purpose, keyed_generator, keyed_seed
from tcmrl_data.parts.operation import OPERATIONS, Operation, Simulator, Sources, WantedPart, check_finite
from tcmrl_data.store.manifest import Run
from tcmrl_data.store.part import STANDARD_ARRAYS, Identity, PartRecord, References
from tcmrl_data.store.tables import MAX_COUNT, MAX_INDEX

EXTEND = "extend"
MAX_NOISE = 10.0

StreamKey = tuple[int, str, int, Purpose, *tuple[int, ...]]
"""Arguments of `keyed_sequence` but for the episode."""


@final
class Rollout(Operation[Record]):
    """The recipe's episodes of a policy in the task that it was made for; its parts have no `derived`."""

    name = "rollout"
    kinds = ("built",)
    Settings = Record
    simulates = True
    own_seeds = True

    def episodes(self, wanted: WantedPart, sources: Sources) -> list[Trajectory]:
        """The episodes 0, 1, … of the policy's keyed seeds."""
        return act(_policy_of(wanted), sources.running, parameters=wanted.task.parameters)

    def derived(self, source: PartRecord) -> None:
        """None: it is made from no other part."""

    def seeded_as(self, task: int, number: int, run: Run) -> tuple[int, int]:
        """The task and the position."""
        return task, number


class ExtendSettings(Record):
    """Settings of an extended part.

    Attributes:
        task: the task that the policy was made for.
        parameters: of that task; scripted policies act by them.
        first_episode: number of the part's first episode among those of its keyed seeds.
        noise: standard deviation of normal noise that was added to actions.
    """

    task: int = Field(ge=0, lt=MAX_INDEX)
    parameters: dict[str, Any]
    first_episode: int = Field(ge=0, lt=MAX_INDEX)
    noise: float = Field(ge=0, le=MAX_NOISE)


@final
class Extend(Operation[ExtendSettings]):
    """Further episodes of a stored policy, in its own task or in another."""

    name = EXTEND
    kinds = ("extended",)
    Settings = ExtendSettings
    simulates = True
    own_seeds = True
    example: ClassVar[Mapping[str, Any]] = {"first_episode": 4, "noise": 0.1}

    @classmethod
    def settings_for(cls, settings: Mapping[str, Any], source: Task) -> Mapping[str, Any]:
        """The settings with the policy's task."""
        return {"task": source.index, "parameters": dict(source.parameters), **settings}

    @classmethod
    def settings_of(cls, run: Run, source: Run) -> Mapping[str, Any]:
        """First episode and noise, as the run's origin says."""
        return {name: (run.origin or {}).get(name) for name in ("first_episode", "noise")}

    def episodes(self, wanted: WantedPart, sources: Sources) -> list[Trajectory]:
        """As many episodes as the recipe says, from `first_episode` on."""
        settings = self.settings
        return act(
            _policy_of(wanted),
            sources.running,
            parameters=settings.parameters,
            first_episode=settings.first_episode,
            noise=settings.noise,
        )

    def seeded_as(self, task: int, number: int, run: Run) -> tuple[int, int]:
        """Episodes are counted from `first_episode`."""
        return task, self.settings.first_episode + number


def _policy_of(wanted: WantedPart) -> Snapshot:
    if wanted.snapshot is None:
        raise BuildError("its policy is not known")
    return wanted.snapshot


def act(
    snapshot: Snapshot,
    simulator: Simulator,
    *,
    parameters: Mapping[str, Any],
    first_episode: int = 0,
    noise: float = 0.0,
) -> list[Trajectory]:
    """The recipe's episodes of one policy, in lane batches; every episode has its own keyed seeds.

    Args:
        simulator: of the task in which it acts.
        parameters: of the task that the policy was made for.
        first_episode: number of the first episode; a multiple of the lanes, so that batches are the same.
        noise: standard deviation of normal noise that is added to actions.
    """
    environment, step = simulator.environment, snapshot.step
    key = (simulator.seed, environment.name, simulator.task.index)
    return _batches(
        simulator,
        snapshot.controller(environment, [parameters] * simulator.lanes.num_lanes),
        episodes=range(first_episode, first_episode + simulator.recipe.rollouts.episodes),
        reset_key=(*key, Purpose.ROLLOUT_RESET, step),
        noise_key=(*key, Purpose.ROLLOUT_NOISE, step),
        added_noise=(noise, (*key, Purpose.EXTENSION_NOISE, step)) if noise else None,
    )


def measure_references(simulator: Simulator) -> References:
    """Uniform, oracle and noise-free scripted returns of the task, over as many episodes as a part has."""
    environment, parameters = simulator.environment, [simulator.task.parameters] * simulator.num_lanes
    key = (simulator.seed, environment.name, simulator.task.index)

    def mean_return(controller: Controller | None) -> float | None:
        if controller is None:
            return None
        trajectories = _batches(
            simulator,
            controller,
            episodes=range(simulator.recipe.rollouts.episodes),
            reset_key=(*key, Purpose.REFERENCE_RESET),
            noise_key=(*key, Purpose.REFERENCE_NOISE),
        )
        check_finite(trajectories, f"{environment.name}, task {simulator.task.index}, reference rollouts")
        return float(np.mean([trajectory.undiscounted_return for trajectory in trajectories]))

    return References(
        uniform=mean_return(UniformController()),
        oracle=mean_return(environment.oracle(parameters)),
        scripted=mean_return(environment.scripted(parameters, 0.0)),
    )


def _batches(
    simulator: Simulator,
    controller: Controller,
    *,
    episodes: range,
    reset_key: StreamKey,
    noise_key: StreamKey,
    added_noise: tuple[float, StreamKey] | None = None,
) -> list[Trajectory]:
    lanes, trajectories = simulator.lanes, list[Trajectory]()
    for first in range(episodes.start, episodes.stop, lanes.num_lanes):
        batch = range(first, first + lanes.num_lanes)
        acting = controller
        if added_noise is not None:
            sigma, key = added_noise
            acting = NoisyController(controller, sigma, [keyed_generator(*key, episode) for episode in batch])
        trajectories += roll_out(
            simulator.environment,
            lanes,
            acting,
            reset_seeds=[keyed_seed(*reset_key, episode) for episode in batch],
            noise=[keyed_generator(*noise_key, episode) for episode in batch],
        )
    return trajectories


RELABEL = "relabel"


class RelabelSettings(Record):
    """Settings of a relabelled part.

    Attributes:
        task: the task that the episodes come from.
        first_episode: number of the part's first episode among those of its keyed seeds.
    """

    task: int = Field(ge=0, lt=MAX_INDEX)
    first_episode: int = Field(ge=0, lt=MAX_INDEX)


@final
class Relabel(Operation[RelabelSettings]):
    """Stored episodes with the rewards of another task: each is reset with its seed and played again."""

    name = RELABEL
    kinds = ("relabelled",)
    Settings = RelabelSettings
    simulates = True
    keeps = ("observations", "actions", "episode_offsets")
    example: ClassVar[Mapping[str, Any]] = {"first_episode": 0}

    @classmethod
    def settings_for(cls, settings: Mapping[str, Any], source: Task) -> Mapping[str, Any]:
        """The settings with the task of the episodes."""
        return {"task": source.index, **settings}

    @classmethod
    def settings_of(cls, run: Run, source: Run) -> Mapping[str, Any]:
        """The first episode of the parts that are relabelled."""
        return {"first_episode": first_episode_of(source)}

    def episodes(self, wanted: WantedPart, sources: Sources) -> list[Trajectory]:
        """The episodes of the part with the rewards of the wanted part's task.

        Raises:
            SimulationError: an observation or an episode's end is not as stored; names the first step.
        """
        simulator, settings = sources.running, self.settings
        trajectories, lanes = sources.part.episodes(), simulator.lanes
        key = (
            simulator.seed,
            simulator.environment.name,
            settings.task,
            Purpose.ROLLOUT_RESET,
            wanted.step,
        )
        made: list[Trajectory] = []
        for first in range(0, len(trajectories), lanes.num_lanes):
            batch = trajectories[first : first + lanes.num_lanes]
            numbers = range(settings.first_episode + first, settings.first_episode + first + len(batch))
            again = roll_out(
                simulator.environment,
                lanes,
                PlaybackController([episode.actions for episode in batch]),
                reset_seeds=[keyed_seed(*key, number) for number in numbers],
                noise=[np.random.default_rng(0) for _ in batch],  # drawn by every rollout, and not used
            )
            for number, old, new in zip(numbers, batch, again, strict=True):
                _check_equal(old, new, f"task {settings.task}, step {wanted.step}", number, wanted.task)
            made += again
        return made

    def seeded_as(self, task: int, number: int, run: Run) -> tuple[int, int]:
        """Episodes start as those of the task that they come from."""
        return self.settings.task, self.settings.first_episode + number


def first_episode_of(run: Run) -> int:
    """Number of the first episode of a run's parts: 0, but for extended ones."""
    return int((run.origin or {}).get("first_episode", 0))


def _check_equal(old: Trajectory, new: Trajectory, part: str, episode: int, target: Task) -> None:
    rows = min(len(old.observations), len(new.observations))
    unequal = (_bits(old)[:rows] != _bits(new)[:rows]).any(axis=1)
    if unequal.any() or len(old) != len(new):
        step = int(unequal.argmax()) if unequal.any() else rows - 1
        what = "observations differ" if unequal.any() else "one of the two ends"
        raise SimulationError(
            f"{part}: cannot be relabelled to task {target.index}, which has other dynamics or starts: "
            f"{what} at step {step} of episode {episode}, so that rewards would be invented"
        )


def _bits(trajectory: Trajectory) -> npt.NDArray[np.uint32]:
    """The observations, of which -0 and 0 differ and NaN equals NaN."""
    return np.ascontiguousarray(trajectory.observations, dtype=np.float32).view(np.uint32)


SUBSET = "subset"
"""Operation of parts that lack episodes or arrays of another, and of datasets that lack parts."""


class CutSettings(Record):
    """What is kept of a part.

    Attributes:
        episodes: positions of the episodes, such as `0-9,12`; null keeps all.
        without: extra arrays that are left out.
    """

    episodes: str | None = None
    without: tuple[str, ...] = ()


@final
class Cut(Operation[CutSettings]):
    """Some of the episodes of another part, or all without some of its extra arrays."""

    name = SUBSET
    kinds = ("subset",)
    Settings = CutSettings
    example: ClassVar[Mapping[str, Any]] = {"episodes": "0-1"}

    @classmethod
    def of(cls, episodes: Sequence[int] | None = None, *, without: Collection[str] = ()) -> "Cut":
        """The cut that keeps the episodes at some positions, all where None."""
        kept = None if episodes is None else write_ranges(episodes)
        return cls(CutSettings(episodes=kept, without=tuple(sorted(without))))

    @property
    def positions(self) -> list[int] | None:
        """Positions of the episodes that are kept; None for all."""
        episodes = self.settings.episodes
        return None if episodes is None else read_ranges(episodes, limit=MAX_COUNT)

    def episodes(self, wanted: WantedPart, sources: Sources) -> list[Trajectory]:
        """The kept episodes of the other part."""
        part, without = sources.part, self.settings.without
        names = set(part.record.identity.arrays)
        for name in without:
            if name in STANDARD_ARRAYS or name not in names:
                extras = ", ".join(sorted(names - set(STANDARD_ARRAYS))) or "none"
                raise SelectionError(
                    f"{part.place}: {name!r} cannot be left out; its extra arrays are: {extras}"
                )
        trajectories = part.episodes(without=without)
        positions = self.positions
        kept = range(len(trajectories)) if positions is None else positions
        if not kept or kept[-1] >= len(trajectories):
            raise SelectionError(f"{part.place} has {len(trajectories)} episodes; keep some of them")
        return [trajectories[position] for position in kept]

    def derived(self, source: PartRecord) -> dict[str, Any]:
        """A cut of a cut is recorded as one cut of the first part: equal contents have equal ids."""
        before = source.identity.derived
        if before is None or before.get("operation") != SUBSET:
            return self._cut_from(source.id)
        origin, earlier = read_cut(source.identity)
        first, then = earlier.positions, self.positions
        if first is not None and then is not None:
            then = [first[position] for position in then]
        without = (*earlier.settings.without, *self.settings.without)
        return Cut.of(first if then is None else then, without=without)._cut_from(origin)

    def seeded_as(self, task: int, number: int, run: Run) -> tuple[int, int]:
        """As in the part that was cut, of which the run says how it came about."""
        origin = run.origin or {}
        positions = self.positions
        position = number if positions is None else positions[number]
        source = run.source_of(task) if origin.get("operation") == RELABEL else task
        return source, first_episode_of(run) + position

    def _cut_from(self, origin: str) -> dict[str, Any]:
        settings = self.settings.model_dump(mode="json")
        return {"operation": SUBSET, "from": [origin], "settings": settings}


def read_cut(identity: Identity) -> tuple[str, Cut]:
    """The id of the part that a part was cut from, and the cut.

    Raises:
        ValueError: its `derived` does not describe a cut that leaves as many episodes as there are.
    """
    derived = identity.derived or {}
    origin, settings = derived.get("from"), derived.get("settings")
    if derived.get("operation") != SUBSET or not isinstance(settings, dict):
        raise ValueError("is no cut")
    if not (isinstance(origin, list) and len(origin) == 1 and isinstance(origin[0], str)):
        raise ValueError("does not name the one part that it was cut from")
    episodes, without = settings.get("episodes"), settings.get("without")
    if not isinstance(episodes, str | None) or not isinstance(without, list):
        raise ValueError("does not say which episodes and arrays were kept")
    if set(map(str, without)) & set(identity.arrays):
        raise ValueError("names an array that is there")
    number = identity.arrays["episode_offsets"].shape[0] - 1
    if episodes is not None and count_ranges(episodes, limit=MAX_COUNT) != number:
        raise ValueError(f"does not name {number} episodes")
    return origin[0], Cut(CutSettings(episodes=episodes, without=tuple(map(str, without))))


@final
class Import(Operation[Record]):
    """Episodes that another program, or a recorder, has made: no identity says how to make them again."""

    name = "import"
    kinds = ("imported", "recorded")
    Settings = Record

    def episodes(self, wanted: WantedPart, sources: Sources) -> list[Trajectory]:
        """Raises."""
        raise BuildError("its seed or its policy is not known")


OWN_OPERATIONS: Mapping[str, type[Operation[Any]]] = {
    operation.name: operation for operation in (Rollout, Cut, Extend, Relabel, Import)
}
"""Known without their entry points, which building would have to load."""


def operation_named(name: str) -> type[Operation[Any]]:
    """The operation of a name, of this package or of another."""
    return OWN_OPERATIONS.get(name) or OPERATIONS.get(name)


def operation_of_run(run: Run) -> type[Operation[Any]]:
    """The operation that makes the parts of a run; errors as of `operation_named`."""
    own = next((operation for operation in OWN_OPERATIONS.values() if run.kind in operation.kinds), None)
    return own or operation_named(str((run.origin or {}).get("operation")))


def operation_of(identity: Identity, place: str) -> Operation[Any]:
    """The operation that makes a part.

    Raises:
        ManifestError: its settings are not valid; names the place and the field.
    """
    derived = identity.derived
    if derived is None:
        unknown = identity.seed is None or identity.policy is None
        return (Import if unknown else Rollout)(Record())
    kind = operation_named(str(derived.get("operation"))[:64])
    try:
        return kind(as_model(kind.Settings, derived.get("settings")))
    except ValidationError as error:
        raise ManifestError(f"{place}: identity.derived.settings: {first_problem(error)}") from None
