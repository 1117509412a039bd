"""Pushing a dataset, to the Hub with a card and with tables that its viewer and `load_dataset` read."""

from pathlib import Path

from tcmrl_data.dataset.dataset import open_dataset
from tcmrl_data.describe.card import MAX_CARD_BYTES, write_card
from tcmrl_data.foundation.files import read_plain_file
from tcmrl_data.remote.files import Progress
from tcmrl_data.remote.local import PushReport
from tcmrl_data.remote.push import push_folder
from tcmrl_data.store.manifest import dataset_folder


def push_dataset(
    dataset: str | Path,
    url: str,
    *,
    tag: str | None = None,
    move: bool = False,
    progress: Progress | None = None,
) -> PushReport:
    """Copies a dataset to an address. The same call, made again after an interruption, goes on.

    Args:
        url: of a folder in a bucket, such as `s3://bucket/point-robot`, or of a dataset of the Hub, such as
            `hf://datasets/owner/name`, which also gets a card and Parquet for the Hub's viewer.
        tag: a name for this state of the dataset; it is opened as `url@tag`. Without a tag the address itself
            names the dataset, and names it for good.
        move: the tag may name another dataset already, and names this one from now on.
        progress: called with bytes that are there, and bytes in all.

    Raises:
        RemoteError: the address or the tag names another dataset, or the server refuses something.
        ManifestError: there is no dataset in the folder, or it names no licence or citation.
        StoreError: a part is missing or damaged.
        MissingPackageError: the store's package, or pyarrow for the Hub, is not installed.

    Example:
        >>> push_dataset("data/point-robot", "s3://bucket/point-robot", tag="v1")  # doctest: +SKIP
    """
    folder = dataset_folder(dataset)

    def describe(out: Path) -> None:
        readme = folder / "README.md"
        if readme.is_file():  # what was written between its marks stays
            (out / readme.name).write_bytes(read_plain_file(readme, limit=MAX_CARD_BYTES))
        write_card(open_dataset(folder), out / readme.name, viewer=True)

    return push_folder(folder, url, tag=tag, move=move, describe=describe, progress=progress)
