"""ZIP files as a stranger may write them: every field of every header can be set."""

import io
import struct
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from zlib import crc32

from tcmrl_data.store.archive import LONGEST_NAME

Fields = Mapping[str, int | bytes]


@dataclass(frozen=True)
class Member:
    """A member, with the fields of its headers that are not what they should be.

    Attributes:
        behind: bytes between this member's content and what follows.
    """

    name: bytes
    content: bytes = b""
    both: Fields = field(default_factory=dict)
    local: Fields = field(default_factory=dict)
    central: Fields = field(default_factory=dict)
    extra: bytes = b""
    behind: bytes = b""


def forge(
    members: Sequence[Member], end: Fields | None = None, *, before: bytes = b"", middle: bytes = b""
) -> bytes:
    """A ZIP of these members; without any field set, the one that `pack_archive` writes.

    Args:
        members: in the order of the file.
        end: fields of the end record.
        before: bytes before the first member.
        middle: bytes between the directory and the end record.
    """
    body, directory = before, b""
    for member in members:
        common: dict[str, int | bytes] = {
            "needed": 20,
            "flags": 0,
            "method": 0,
            "time": 0,
            "date": 33,
            "checksum": crc32(member.content),
            "packed": len(member.content),
            "size": len(member.content),
            "name_length": len(member.name),
            "extra_length": len(member.extra),
            **member.both,
        }
        rest = {"comment_length": 0, "disk": 0, "internal": 0, "external": 0o100644 << 16}
        central = {"signature": b"PK\1\2", "made_by": 788, **common, **rest, "offset": len(body)}
        local = {"signature": b"PK\3\4", **common}
        directory += _packed("<4s6H3L5H2L", central, member.central) + member.name + member.extra
        body += _packed("<4s5H3L2H", local, member.local) + member.name + member.extra
        body += member.content + member.behind
    last = {
        **{"signature": b"PK\5\6", "disk": 0, "directory_disk": 0, "here": len(members), "all": len(members)},
        **{"length": len(directory), "start": len(body), "comment_length": 0},
    }
    return body + directory + middle + _packed("<4s4H2LH", last, end or {})


def _packed(layout: str, fields: Fields, forged: Fields) -> bytes:
    assert set(forged) <= set(fields)
    return struct.pack(layout, *(fields | dict(forged)).values())


def zipped(files: Mapping[str, bytes], method: int = zipfile.ZIP_STORED) -> bytes:
    """What Python's own ZIP writer makes of files, dated and marked as ours."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in files.items():
            member = zipfile.ZipInfo(name)
            member.external_attr = 0o100644 << 16
            archive.writestr(member, content, method)
    return buffer.getvalue()


def sized(member: Member, size: int) -> Member:
    return Member(member.name, member.content, both={"packed": size, "size": size})


FILES = {"arrays/zarr.json": b"{}", "arrays/a/c/0": bytes(range(60)), "part.json": b'{"schema_version": 2}'}
HONEST = [Member(name.encode(), content) for name, content in FILES.items()]
FIRST, SECOND, THIRD = HONEST
LARGE = 2**32 - 1

INNER = forge([Member(b"inner", b"hidden")])
"""41 bytes of header and content, 51 of directory, 22 of end record."""

START = len(forge(HONEST)) - 22 - sum(46 + len(member.name) for member in HONEST)
"""Where the directory of the honest archive starts."""

ZIP64_END = struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, 3, 3, START + 1, START)
ZIP64 = ZIP64_END + struct.pack("<4sLQL", b"PK\6\7", 0, len(forge(HONEST)) - 22, 1)
ZIP64_EXTRA = struct.pack("<2H2Q", 1, 16, 2, 2)
LOCAL_LIES = {
    **{"signature": b"PK\1\2", "flags": 1, "method": 8, "checksum": 0, "packed": 1, "size": 1},
    **{"needed": 45, "time": 1, "date": 0, "name_length": 0, "extra_length": 1},
}
NAMES = [b"", b".", b"..", b"../a", b"a/..", b"/a", b"a/", b"a//b", b"./a", b"a/./b", b".a", b"a\\b", b"C:"]
NAMES += [b"A", b"a b", b"a\n", b"a\0", b"\xc3\xa4", b"a" * (LONGEST_NAME + 1)]

FORGED = {
    "an empty file": b"",
    "no archive": b"PK" + bytes(100),
    "a script before, directory moved": forge(HONEST, before=b"#!/bin/sh\n"),
    "a script before, directory as it was": b"#!/bin/sh\n" + forge(HONEST),
    "data after": forge(HONEST) + b"data",
    "an archive before": INNER + forge(HONEST),
    "an archive after": forge(HONEST) + INNER,
    "a comment": forge(HONEST, {"comment_length": 4}) + b"text",
    "a comment that is an end record": forge(HONEST, {"comment_length": 22}) + forge(HONEST)[-22:],
    "data between members": forge([Member(b"a", b"1", behind=b"hidden"), SECOND]),
    "data between the last member and the directory": forge([Member(b"a", b"1", behind=b"hidden")]),
    "data before the directory, said to start earlier": forge(
        [Member(b"a", b"1", behind=b"hidden")], {"start": 32}
    ),
    "data behind the directory, said to be longer": forge(
        [Member(b"a", b"1")], {"length": 47 + 6}, middle=b"hidden"
    ),
    "data between the directory and the end record": forge(HONEST, middle=b"hidden"),
    "a member that the directory leaves out": forge([Member(b"a", b"1", behind=INNER[:41]), SECOND]),
    "a member that the count leaves out": forge(HONEST, {"here": 2, "all": 2}),
    "a member more than there are": forge(HONEST, {"here": 4, "all": 4}),
    "no members but their content": forge(HONEST, {"here": 0, "all": 0}),
    "65,535 members": forge(HONEST, {"here": 65535, "all": 65535}),
    "a second disk": forge(HONEST, {"disk": 1}),
    "one name twice": forge([FIRST, FIRST]),
    "two members at one place": forge([FIRST, Member(b"arrays/zarr.json", b"{}", central={"offset": 0})]),
    "a member inside another": forge(
        [Member(b"a", forge([Member(b"b", b"1")])[:32]), Member(b"b", b"1", central={"offset": 31})]
    ),
    "members in another order": forge([Member(b"a", b"1", central={"offset": 32}), Member(b"b", b"2")]),
    "a member beyond the file": forge([Member(b"a", b"1", central={"offset": LARGE})]),
    "zip64 records": forge(HONEST, middle=ZIP64),
    "zip64 in the end record": forge(HONEST, {"here": 65535, "all": 65535, "start": LARGE}, middle=ZIP64),
    "zip64 sizes": forge([Member(b"a", b"{}", both={"packed": LARGE, "size": LARGE}, extra=ZIP64_EXTRA)]),
    "zip64 sizes of a pebibyte": forge(
        [
            Member(
                b"a",
                b"{}",
                both={"packed": LARGE, "size": LARGE},
                extra=struct.pack("<2H2Q", 1, 16, *[2**50] * 2),
            )
        ]
    ),
    "a zip64 offset beyond the file": forge(
        [Member(b"a", b"{}", central={"offset": LARGE}, extra=struct.pack("<2HQ", 1, 8, 2**63))]
    ),
    "a zip64 field without its sizes": forge(
        [Member(b"a", b"{}", both={"packed": LARGE, "size": LARGE}, extra=struct.pack("<2H", 1, 0))]
    ),
    "an extra field that says more than it holds": forge(
        [Member(b"a", b"{}", extra=struct.pack("<2H", 0x5455, 2**16 - 1))]
    ),
    "a zip64 directory of an exbibyte": forge(
        HONEST,
        {"here": 65535, "all": 65535, "length": LARGE, "start": LARGE},
        middle=struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, 3, 3, 2**60, START) + ZIP64[56:],
    ),
    "an extra field": forge([Member(b"a", b"{}", extra=ZIP64_EXTRA)]),
    "an extra field in the local header alone": forge(
        [Member(b"a", ZIP64_EXTRA + b"{}", local={"extra_length": len(ZIP64_EXTRA)})]
    ),
    "a comment of a member": forge([Member(b"a", b"{}", central={"comment_length": 22})]),
    "a directory inside a member": forge([Member(b"a", INNER)], {"start": 31}),
    "a directory that is another's": forge([Member(b"a", INNER)], {"start": 31 + 41, "length": 51}),
    "a directory before the file": forge(HONEST, {"start": LARGE}),
    "a directory longer than the file": forge(HONEST, {"length": LARGE}),
    "a directory of no bytes": forge(HONEST, {"length": 0}),
    "a link": forge([Member(b"a", b"/etc/passwd", central={"external": 0o120777 << 16})]),
    "an encrypted member": forge([Member(b"a", b"1", both={"flags": 1})]),
    "sizes behind the content": forge([Member(b"a", b"1", both={"flags": 8})]),
    "a date": forge([Member(b"a", b"1", both={"date": 34})]),
    "a wrong checksum": forge([Member(b"a", b"1", both={"checksum": 1})]),
    "deflate": zipped(FILES, zipfile.ZIP_DEFLATED),
    "bzip2": zipped(FILES, zipfile.ZIP_BZIP2),
    "deflate, by the headers alone": forge([Member(b"a", b"1", both={"method": 8})]),
    **{
        f"a size of {size} for {len(SECOND.content)} bytes": forge([FIRST, sized(SECOND, size), THIRD])
        for size in (0, 59, 61, 2**31, LARGE)
    },
    "two sizes beyond 32 bits together": forge([sized(FIRST, LARGE), sized(SECOND, LARGE), THIRD]),
    **{
        f"{key} in the local header alone": forge([Member(b"a", b"12", local={key: value})])
        for key, value in LOCAL_LIES.items()
    },
    "another name in the local header": forge([Member(b"a", b"1")]).replace(b"a1", b"b1"),
    **{f"the name {name!r:.20}": forge([Member(name)]) for name in NAMES},
}
