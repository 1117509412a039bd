"""Links, special files and foreign files in a dataset."""

import os
from pathlib import Path

from tcmrl_data.store.manifest import MANIFEST
from tests.hostile.case import ESCAPE, device, in_file, linked, socket_file, special_file, two_names
from tests.hostile.datasets import OTHER, PART

FILES = [
    in_file("part linked", linked(PART), PART, "a link", "read"),
    in_file("part linked to a device", special_file(PART, device), PART, "a link", "read"),
    in_file(
        "part linked to nothing",
        special_file(PART, lambda p: p.symlink_to("/nothing")),
        PART,
        "a link",
        "read",
    ),
    in_file(
        "part linked to itself", special_file(PART, lambda p: p.symlink_to(p.name)), PART, "a link", "read"
    ),
    in_file(
        "part linked to the other",
        special_file(PART, lambda p: p.symlink_to(f"../../../{OTHER}")),
        PART,
        "a link",
        "read",
    ),
    in_file("task linked", linked("parts/main/00000"), "parts/main/00000", "a link", "read"),
    in_file("run linked", linked("parts/main"), "parts/main", "a link", "read"),
    in_file("parts linked", linked("parts"), "parts", "a link", "read"),
    in_file("manifest linked", linked(MANIFEST), MANIFEST, "a link", "open"),
    in_file("part of two names", two_names(PART), PART, "hard links", "read"),
    in_file("manifest of two names", two_names(MANIFEST), MANIFEST, "hard links", "open"),
    in_file("part a FIFO", special_file(PART, os.mkfifo), PART, "a FIFO", "read"),
    in_file("manifest a FIFO", special_file(MANIFEST, os.mkfifo), MANIFEST, "a FIFO", "open"),
    in_file("part a socket", special_file(PART, socket_file), PART, "a socket", "read"),
    in_file("part a folder", special_file(PART, Path.mkdir), PART, "", "read"),
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
        "file of broken name",
        lambda f: Path(os.fsdecode(bytes(f.folder) + b"/\xff\xfe")).touch(),
        "\udcff\udcfe",
        "no part",
    ),
    in_file(
        "code beside the part",
        lambda f: (f.part.parent / "sitecustomize.py").write_text("import os"),
        "sitecustomize.py",
        "no part",
    ),
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
    in_file(
        "lock linked", lambda f: (f.folder / ".lock").symlink_to(f.outside / "secret"), ".lock", "a link"
    ),
]
