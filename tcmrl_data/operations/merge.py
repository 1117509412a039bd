"""`merge_datasets`: the union of datasets of one environment."""

from collections.abc import Sequence
from pathlib import Path

from tcmrl_data.dataset.dataset import Dataset, open_dataset
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.operations.assembly import check_out
from tcmrl_data.operations.derive import Derived, summary
from tcmrl_data.operations.merging import plan_merge
from tcmrl_data.operations.plan import Progress, carry_out
from tcmrl_data.operations.rename import check_label


def merge_datasets(
    sources: Sequence[str | Path | Dataset],
    out: str | Path,
    *,
    names: Sequence[str] | None = None,
    split_from: str | Path | Dataset | None = None,
    label: str | None = None,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> Derived:
    """Makes the union of datasets; parts keep ids and bytes, and their order does not matter.

    The sources have the same environment settings, and the tasks that several of them hold have the same
    parameters. A part that several sources hold is taken once. Parts with equal keys and other ids, such as
    those of other seeds, become another run.

    Args:
        sources: datasets or views, at least two.
        out: folder of the union.
        names: of the run `main` of each source in the union; without names, runs keep theirs where they are
            free, and the others are called by their seed or kind.
        split_from: the source that decides which tasks are training tasks, where sources disagree.
        label: the union's own name.
        dry_run: only say what would be made.
        progress: called with parts done and parts in all.

    Raises:
        SelectionError: fewer than two sources, or sources that disagree; names what, and both values.
        StoreError: `out` exists, a part is damaged, or a source has changed meanwhile.
        StorageError: the operating system refuses an operation.
        LockedError: another process writes to `out`.

    Example:
        >>> merge_datasets(["data/pr-seed0", "data/pr-seed1"], "data/pr-two-seeds")  # doctest: +SKIP
    """
    check_label(label)
    opened = [source if isinstance(source, Dataset) else open_dataset(source) for source in sources]
    if len(opened) < 2 or (names is not None and len(names) != len(opened)):
        raise SelectionError(
            f"a merge takes two datasets or more, got {len(opened)}, and as many names or none"
        )
    deciding = None
    if split_from is not None:
        deciding = split_from if isinstance(split_from, Dataset) else open_dataset(split_from)
    plan = plan_merge(
        opened,
        names=names or (),
        split_from=None if deciding is None else deciding.manifest.digest,
        label=label,
    )
    target = Path(out)
    if dry_run:
        check_out(target, plan.derivation)
        return summary(plan, target, root=None)
    return summary(plan, target, root=carry_out(plan, target, progress).root)
