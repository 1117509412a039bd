"""Where a forged file for `tcmrl-data import` is made."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

TEBI = 2**43


class Places(NamedTuple):
    """Where a case writes: its own folder, a file that nobody may read, a file that code would make."""

    folder: Path
    secret: Path
    marker: Path


Make = Callable[[Places], Path]
