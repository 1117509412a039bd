"""A forgery and the ways to make one, for all rooms of a dataset."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tests.hostile.datasets import PART, Forge, Values

ESCAPE = "\x1b]0;owned\x07\x1b[2J"
Stage = Literal["open", "tables", "read", "verify"]
Damage = Callable[[Forge], object]


@dataclass(frozen=True)
class Case:
    """One forgery.

    Attributes:
        damage: makes it.
        file: end of the path that the error and a finding must name.
        words: what error and finding must say, at least the field.
        stage: the first stage that must refuse: the manifest, the tables, reading arrays and policy, or
            deep verification.
    """

    name: str
    damage: Damage
    file: str
    words: tuple[str, ...]
    stage: Stage


def in_part(name: str, damage: Damage, member: str, words: str, stage: Stage = "read") -> Case:
    """A forgery within the archive; error and finding must name the member too."""
    return Case(name, damage, PART, (member, words), stage)


def in_file(name: str, damage: Damage, file: str, words: str, stage: Stage = "verify") -> Case:
    return Case(name, damage, file, (words,), stage)


def with_field(**fields: Any) -> Damage:
    return lambda forge: forge.manifest(lambda values: values.update(fields))


def with_recipe(change: Callable[[Values], object]) -> Damage:
    return lambda forge: forge.manifest(lambda values: change(values["runs"][0]["recipe"]))


def with_run(**fields: Any) -> Damage:
    return lambda forge: forge.manifest(lambda values: values["runs"][0].update(fields))


def with_name(name: str) -> Damage:
    return lambda forge: forge.manifest(
        lambda values: (
            values.update(name=name),
            values["runs"][0]["recipe"]["environment"].update(name=name),
        )
    )


def special_file(name: str, make: Callable[[Path], object]) -> Damage:
    def damage(forge: Forge) -> None:
        (forge.folder / name).unlink()
        make(forge.folder / name)

    return damage


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")
