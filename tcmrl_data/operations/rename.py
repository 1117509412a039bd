"""`rename_dataset`: a dataset's own name."""

from pathlib import Path

from tcmrl_data.foundation.disk import LOCK, STAGING, lock_file, replace_file
from tcmrl_data.foundation.errors import SelectionError
from tcmrl_data.foundation.records import hidden_text
from tcmrl_data.store.manifest import MANIFEST, Manifest, dataset_folder, read_manifest, seal

LONGEST_LABEL = 200


def rename_dataset(path: str | Path, label: str) -> Manifest:
    """Gives a dataset another label; its digest changes, its root does not, and its folder stays.

    Args:
        path: the dataset's folder or its `manifest.json`.
        label: the new name, such as `pr/two-seeds`.

    Returns:
        The new manifest.

    Raises:
        SelectionError: the label is empty, too long, or holds control characters.
        ManifestError: there is no dataset at the path.
        LockedError: another process works on the dataset.
        ReadOnlyError: the folder cannot be written.

    Example:
        >>> rename_dataset("data/pr-two-seeds", "pr/two-seeds")  # doctest: +SKIP
    """
    check_label(label)
    folder = dataset_folder(path)
    read_manifest(folder)
    with lock_file(folder / LOCK, f"dataset {folder}"):
        fields = read_manifest(folder).model_dump(mode="json", exclude={"digest"})
        replace_file(folder / MANIFEST, seal(fields | {"label": label}), staging=folder / STAGING)
        return read_manifest(folder)


def check_label(label: str | None) -> None:
    """Refuses a label that no manifest may hold.

    Raises:
        SelectionError: it is empty, too long, or holds control characters.
    """
    if label is not None and (
        not label.strip() or len(label) > LONGEST_LABEL or "\n" in label or hidden_text(label, "label")
    ):
        raise SelectionError(
            f"label {label[:40]!r}: expected 1 to {LONGEST_LABEL} characters that can be printed on a line"
        )
