"""An export's folder: it appears whole, or not at all."""

import contextlib
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

from tcmrl_data.foundation.disk import move_into_place, sync_tree
from tcmrl_data.foundation.errors import StoreError


@contextlib.contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Gives a folder beside `out` to write into; forced to disk and renamed to `out` at the end.

    Raises:
        StoreError: `out` exists and is not empty.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise StoreError(f"--out {out} exists and is not empty; choose another folder or remove it")
    out.parent.mkdir(parents=True, exist_ok=True)
    staged = out.with_name(f".{out.name}.{uuid.uuid4().hex}.partial")
    staged.mkdir()
    try:
        yield staged
        sync_tree(staged)
        if not move_into_place(staged, out):
            raise StoreError(f"--out {out} appeared meanwhile; choose another folder or remove it")
    finally:
        shutil.rmtree(staged, ignore_errors=True)
