"""Links, special files and foreign files in a dataset."""

import os

from tcmrl_data.store.manifest import MANIFEST
from tests.hostile.case import ESCAPE, device, in_file, special_file
from tests.hostile.datasets import OTHER, PART, Forge


def _looped(forge: Forge) -> None:
    """A run that is a link to the folder of all runs, and so on for ever."""
    (forge.folder / "parts/main").rename(forge.outside / "main")
    (forge.folder / "parts/main").symlink_to(".")


FILES = [
    in_file("part linked to a device", special_file(PART, device), PART, "a character device", "read"),
    in_file(
        "part linked to nothing",
        special_file(PART, lambda p: p.symlink_to("/nothing")),
        PART,
        "",
        "read",
    ),
    in_file("part linked to itself", special_file(PART, lambda p: p.symlink_to(p.name)), PART, "", "read"),
    in_file("parts linked to themselves", _looped, PART, "", "read"),
    in_file("manifest linked to a device", special_file(MANIFEST, device), MANIFEST, "device", "open"),
    in_file("part a FIFO", special_file(PART, os.mkfifo), PART, "a FIFO", "read"),
    in_file("manifest a FIFO", special_file(MANIFEST, os.mkfifo), MANIFEST, "a FIFO", "open"),
    in_file("part missing", lambda f: f.part.unlink(), PART, "missing", "read"),
    in_file(
        "part of the other",
        lambda f: f.archive((f.folder / OTHER).read_bytes()),
        PART,
        "the manifest",
        "read",
    ),
    in_file("file of odd name", lambda f: (f.folder / "parts" / f"a{ESCAPE}").touch(), ESCAPE, "no part"),
    in_file(
        "pickle beside the part",
        lambda f: (f.part.parent / "policy.pkl").write_bytes(f.payload()),
        "policy.pkl",
        "no part",
    ),
    in_file(
        "part of an odd number",
        lambda f: (f.part.parent / "150.zip").write_bytes(f.part.read_bytes()),
        "150.zip",
        "no part",
    ),
    in_file("lock linked to a device", lambda f: device(f.folder / ".lock"), ".lock", "a character device"),
    in_file(
        "a link to a folder beside the data",
        lambda f: (f.folder / "more").symlink_to(f.outside),
        "more",
        "a link",
    ),
]
