"""ZIP files as a stranger may write them."""

import io
import struct
import zipfile
from collections.abc import Mapping

from tcmrl_data.store.archive import LONGEST_NAME, pack_archive


def zipped(files: Mapping[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """What Python's own ZIP writer makes of files, dated and marked as ours."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in files.items():
            member = zipfile.ZipInfo(name)
            member.external_attr = 0o100644 << 16
            archive.writestr(member, content, method)
    return buffer.getvalue()


def lying(place: int, layout: str, *values: int) -> bytes:
    """An honest archive in which bytes of the directory's last entry are others."""
    data = bytearray(HONEST)
    struct.pack_into(layout, data, data.rindex(b"PK\1\2") + place, *values)
    return bytes(data)


FILES = {"arrays/zarr.json": b"{}", "arrays/a/c/0": bytes(range(60)), "part.json": b'{"schema_version": 2}'}
HONEST = pack_archive(FILES)
LARGE = 2**32 - 1
NAMES = [
    "..",
    "../a",
    "a/..",
    "/a",
    "a//b",
    "./a",
    ".a",
    "a\\b",
    "C:",
    "A",
    "a b",
    "ä",
    "a" * (LONGEST_NAME + 1),
]

FORGED = {
    "an empty file": b"",
    "no archive": b"PK" + bytes(100),
    "a script before": b"#!/bin/sh\n" + HONEST,
    "an archive before": zipped({"inner": b"hidden"}) + HONEST,
    "data after": HONEST + b"data",
    "a comment": HONEST[:-2] + b"\4\0text",
    "a member more than there are": HONEST[:-14] + struct.pack("<2H", 4, 4) + HONEST[-10:],
    "no members but their content": HONEST[:-14] + bytes(4) + HONEST[-10:],
    "one name twice": zipped({"a": b"1", "b": b"2"}).replace(b"b", b"a"),
    "another name in the local header": HONEST.replace(b"part.json", b"port.json", 1),
    "an encrypted member": lying(8, "<H", 1),
    "deflate, by the headers alone": lying(10, "<H", 8),
    "a wrong checksum": lying(16, "<L", 1),
    "two sizes": lying(24, "<L", 1),
    **{f"a size of {size} for 21 bytes": lying(20, "<2L", size, size) for size in (0, 22, 2**31, LARGE)},
    "a link": lying(38, "<L", 0o120777 << 16),
    "two members at one place": lying(42, "<L", 0),
    "a member beyond the file": lying(42, "<L", LARGE),
    "deflate": zipped(FILES, zipfile.ZIP_DEFLATED),
    **{f"the name {name!r:.20}": zipped({name: b""}) for name in NAMES},
}
