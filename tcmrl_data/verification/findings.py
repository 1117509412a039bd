"""What a verification may find."""

from dataclasses import dataclass
from typing import Literal

from tcmrl_data.store.keys import PartKey, key_of_file

VerifyLevel = Literal["quick", "digests", "deep"]


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong.

    Attributes:
        file: path relative to the dataset; a folder where a whole folder is meant.
        problem: what is wrong with it.
        task: task of the part that it belongs to.
        step: snapshot step of that part.
        run: run of that part.
        foreign: it belongs to nothing that the manifest names; repair leaves it alone.
    """

    file: str
    problem: str
    task: int | None = None
    step: int | None = None
    run: str | None = None
    foreign: bool = False

    @property
    def key(self) -> PartKey | None:
        """The part that a finding is about; None for other files, and for foreign ones."""
        return None if self.foreign else key_of_file(self.file)


def finding(file: str, problem: str, *, foreign: bool = False) -> Finding:
    """A finding about a file, which may be a part's."""
    key = key_of_file(file)
    if key is None:
        return Finding(file, problem, foreign=foreign)
    return Finding(file, problem, key.task, key.step, key.run, foreign)
