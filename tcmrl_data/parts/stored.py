"""Parts whose episodes no simulator gives: cuts of other parts, and episodes that others have recorded."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar, final

from tcmrl_data.envs.controller import Trajectory
from tcmrl_data.foundation.errors import BuildError, SelectionError
from tcmrl_data.foundation.records import Record, count_ranges, read_ranges, write_ranges
from tcmrl_data.parts.operation import Operation, Sources, WantedPart
from tcmrl_data.parts.playback import RELABEL, first_episode_of
from tcmrl_data.store.manifest import Run
from tcmrl_data.store.part import STANDARD_ARRAYS, Identity, PartRecord
from tcmrl_data.store.tables import MAX_COUNT

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
        """The kept episodes of the other part.

        Raises:
            SelectionError: it has no such array, or no such episode.
        """
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

    def __init__(self, settings: Record | None = None) -> None:
        super().__init__(settings or Record())

    def episodes(self, wanted: WantedPart, sources: Sources) -> list[Trajectory]:
        """Raises.

        Raises:
            BuildError: always; imported parts come from the importer.
        """
        raise BuildError("its seed or its policy is not known")
