"""Whether a derived dataset is what its derivation says: the derivation is done again and compared."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.foundation.errors import SelectionError, TcmrlError
from tcmrl_data.foundation.plain_files import one_line
from tcmrl_data.operations.merge import MERGE, plan_merge
from tcmrl_data.operations.planning import Plan, PlannedPart
from tcmrl_data.operations.split import EPISODES, FOLD, plan_episodes, plan_fold
from tcmrl_data.operations.subset import Choice, plan_subset
from tcmrl_data.parts.stored import SUBSET, read_cut
from tcmrl_data.store.keys import part_file
from tcmrl_data.store.manifest import MANIFEST, Derivation
from tcmrl_data.store.part_record import PartRecord
from tcmrl_data.store.task_table import TASKS


def origin_problem(record: PartRecord) -> str | None:
    """What is wrong with the record of where a part was cut from."""
    derived = record.identity.derived
    if derived is None or derived.get("operation") != SUBSET:
        return None
    try:
        read_cut(record.identity)
    except ValueError as error:
        return f"identity.derived {one_line(error)}"
    return None


def derivation_problems(
    dataset: Dataset, sources: Sequence[str | Path | Dataset]
) -> Iterator[tuple[str, str]]:
    """Does a dataset's derivation again, without writing, and yields files and how they differ.

    Args:
        dataset: a derived dataset.
        sources: the datasets that it was derived from, in any order.

    Raises:
        SelectionError: the dataset was not derived, a source is missing, or the operation cannot be done
            again here.
    """
    derivation = dataset.manifest.derivation
    if derivation is None:
        raise SelectionError(f"--source: {dataset.path} was not derived from other datasets")
    opened = [source if isinstance(source, Dataset) else open_dataset(source) for source in sources]
    ordered = _in_order(derivation, opened)
    plan_again = _PLANS.get(derivation.operation)
    if plan_again is None:
        raise SelectionError(f"--source: {derivation.operation!r} cannot be done again to compare")
    try:
        plan = plan_again(ordered, derivation.settings)
    except (TcmrlError, KeyError, TypeError, ValueError, IndexError) as error:
        yield MANIFEST, f"derivation cannot be done again ({one_line(error)})"
        return
    yield from _plan_problems(dataset, plan)


def _in_order(derivation: Derivation, sources: Sequence[Dataset]) -> list[Dataset]:
    """The sources as the derivation names them; those of one root by digest, as a merge orders them."""
    ordered, left = [], sorted(sources, key=lambda source: source.manifest.digest)
    for wanted in derivation.sources:
        found = next((source for source in left if source.manifest.root == wanted.root), None)
        if found is None:
            raise SelectionError(
                f"--source: the derivation reads a dataset {wanted.label or ''} with root "
                f"{wanted.root[:12]}; name its folder"
            )
        left.remove(found)
        ordered.append(found)
    return ordered


def _plan_problems(dataset: Dataset, plan: Plan) -> Iterator[tuple[str, str]]:
    if dataset.tasks != plan.tasks:
        yield TASKS, "does not hold the tasks and splits that the derivation gives"
    planned = {part.key: part for part in plan.parts}
    for key in sorted(set(dataset.parts) ^ set(planned)):
        yield part_file(key), f"is {'left out' if key in planned else 'taken'} against the derivation"
    for entry in dataset.parts.entries():
        part = planned.get(entry.key)
        if part is not None and entry.id != _id_of(part):
            yield part_file(entry.key), f"is not what the derivation gives from {part.source.path}"


def _id_of(part: PlannedPart) -> str:
    return part.source.entry(part.source_key).id if part.operation is None else part.make()[0].id


def _subset(sources: Sequence[Dataset], settings: dict[str, Any]) -> Plan:
    (source,) = sources
    return plan_subset(source, Choice.from_json(settings))


def _merge(sources: Sequence[Dataset], settings: dict[str, Any]) -> Plan:
    deciding = settings["split_from"]
    split_from = None if deciding is None else sources[deciding].manifest.digest
    return plan_merge(sources, names=settings["names"], split_from=split_from)


def _fold(sources: Sequence[Dataset], settings: dict[str, Any]) -> Plan:
    (source,) = sources
    return plan_fold(source, folds=settings["folds"], seed=settings["seed"], fold=settings["fold"])


def _episodes(sources: Sequence[Dataset], settings: dict[str, Any]) -> Plan:
    (source,) = sources
    return plan_episodes(source, first=settings["first"], number=settings["number"])


_PLANS: dict[str, Callable[[Sequence[Dataset], dict[str, Any]], Plan]] = {
    SUBSET: _subset,
    MERGE: _merge,
    FOLD: _fold,
    EPISODES: _episodes,
}
