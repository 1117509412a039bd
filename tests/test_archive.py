"""An archive: bytes that any ZIP reader opens, and a check that finds any other form of them."""

import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.store import archive as module
from tcmrl_data.store.archive import MOST_MEMBERS, Archive, pack_archive
from tests.hostile.archives import FILES, FORGED, zipped

names = st.from_regex(r"[a-z0-9_][a-z0-9_.]{0,5}(/[a-z0-9_][a-z0-9_.]{0,5}){0,3}", fullmatch=True)
contents = st.dictionaries(names, st.binary(max_size=300), max_size=6)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("archives") / "part.zip"


def read_all(path: Path) -> dict[str, bytes]:
    with Archive(path) as archive:
        archive.check_form()
        return {name: archive.read(name) for name in archive.names}


def refusal(path: Path) -> str:
    """The message with which opening, reading everything or comparing its form is refused."""
    with pytest.raises(StoreError) as refused:
        read_all(path)
    message = str(refused.value)
    assert message.startswith(str(path)) and message.endswith("; run `tcmrl-data verify --repair`")
    assert message.isprintable()
    return message


@given(files=contents)
def test_files_come_back_from_ours_and_from_pythons_reader(files: dict[str, bytes], path: Path) -> None:
    data = pack_archive(files)
    assert data == pack_archive(files) == zipped(files)
    path.write_bytes(data)
    with Archive(path) as archive:
        assert (archive.names, archive.size) == (tuple(files), len(data))
        assert {name: archive.read(name) for name in reversed(archive.names)} == files
    with zipfile.ZipFile(path) as other:
        assert {name: other.read(name) for name in other.namelist()} == files


@given(data=st.data())
def test_what_the_reader_accepts_is_what_the_writer_writes(data: st.DataObject, path: Path) -> None:
    forged = bytearray(pack_archive(data.draw(contents)))
    for _ in range(data.draw(st.integers(1, 3))):
        start = data.draw(st.integers(0, len(forged)))
        piece = st.one_of(st.binary(max_size=8), st.sampled_from([b"\xff" * 4, bytes(4), b"PK\5\6"]))
        forged[start : start + data.draw(st.integers(0, 8))] = data.draw(piece)
    path.write_bytes(forged)
    try:
        files = read_all(path)
    except StoreError:
        return
    assert pack_archive(files) == forged


def test_every_flipped_bit_and_every_lost_or_added_byte_is_refused(path: Path) -> None:
    data = pack_archive(FILES)
    flipped = [
        data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]
        for at in range(len(data))
        for bit in range(8)
    ]
    shorter = [data[:size] for size in range(len(data))] + [data[start:] for start in range(1, len(data))]
    longer = [data + bytes([value]) for value in range(256)] + [bytes([value]) + data for value in range(256)]
    for forged in (*flipped, *shorter, *longer):
        path.write_bytes(forged)
        refusal(path)


@pytest.mark.parametrize("case", FORGED)
def test_forged_archives_are_refused(case: str, path: Path) -> None:
    path.write_bytes(FORGED[case])
    refusal(path)


def test_a_zip_with_other_dates_opens_and_is_told_from_ours(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as other:
        other.writestr("part.json", b"{}")
    assert "is not written as archives are here" in refusal(path)
    with Archive(path) as archive:
        assert archive.read("part.json") == b"{}"


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (lambda path: path.symlink_to("/dev/zero"), "is a character device, not a plain file"),
        (os.mkfifo, "is a FIFO, not a plain file"),
        (Path.mkdir, "is a folder, not a plain file"),
        (lambda path: path.symlink_to("/nothing"), "is missing"),
        (lambda path: None, "is missing"),
    ],
)
def test_only_plain_files_are_opened(make: Callable[[Path], object], problem: str, tmp_path: Path) -> None:
    make(tmp_path / "part.zip")
    assert problem in refusal(tmp_path / "part.zip")


def test_what_the_system_refuses_is_named_without_advice_to_repair(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StoreError, match=r"cannot be read \(Not a directory\)$"):
        Archive(tmp_path / "file" / "part.zip")


def test_refused_archives_leave_no_file_open(tmp_path: Path) -> None:
    path = tmp_path / "part.zip"
    before = os.listdir("/proc/self/fd")
    for _ in range(50):
        for forged in ("an empty file", "one name twice", "a member beyond the file", "deflate"):
            path.write_bytes(FORGED[forged])
            with pytest.raises(StoreError):
                Archive(path)
    assert os.listdir("/proc/self/fd") == before


def test_a_member_that_is_missing_or_too_large_is_named(path: Path) -> None:
    path.write_bytes(pack_archive(FILES))
    with Archive(path) as archive:
        assert archive.read("part.json", limit=21) == FILES["part.json"]
        with pytest.raises(StoreError, match=r"part.zip: part.json has 21 bytes, more than the 20 allowed"):
            archive.read("part.json", limit=20)
        with pytest.raises(StoreError, match=r"part.zip: policy.json is missing; run"):
            archive.read("policy.json")


def test_a_file_that_shrinks_while_it_is_open_is_refused(path: Path) -> None:
    path.write_bytes(pack_archive(FILES))
    with Archive(path) as archive:
        os.truncate(path, 100)
        assert archive.read("arrays/zarr.json") == b"{}"
        with pytest.raises(StoreError, match=r"part\.json is damaged"):
            archive.read("part.json")


@pytest.mark.parametrize("name", ["", "../a", "/a", "a\\b", "a//b", ".a", "A", "ä", "\udcff", "a" * 129])
def test_the_writer_refuses_names_that_the_reader_would(name: str) -> None:
    with pytest.raises(StoreError, match="a member's name is a relative path of a-z"):
        pack_archive({"part.json": b"", name: b""})


def test_writer_and_reader_agree_on_the_largest_number_of_members(path: Path) -> None:
    files = {f"arrays/a/c/{index}": b"" for index in range(MOST_MEMBERS)}
    path.write_bytes(pack_archive(files))
    assert len(read_all(path)) == MOST_MEMBERS
    files["part.json"] = b""
    with pytest.raises(StoreError, match="at most 32768 members, got 32769"):
        pack_archive(files)
    path.write_bytes(zipped(files))
    assert "has 32769 members" in refusal(path)


def test_writer_and_reader_agree_on_the_largest_size(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = pack_archive(FILES)
    path.write_bytes(data)
    monkeypatch.setattr(module, "LARGEST_ARCHIVE", len(data))
    assert (pack_archive(FILES), read_all(path)) == (data, FILES)
    monkeypatch.setattr(module, "LARGEST_ARCHIVE", len(data) - 1)
    assert f"has {len(data)} bytes, more than the {len(data) - 1} allowed here" in refusal(path)
    with pytest.raises(StoreError, match=f"at most {len(data) - 1} bytes, got {len(data)}"):
        pack_archive(FILES)


def test_more_than_2_gib_are_refused_before_anything_is_copied() -> None:
    block = bytes(2**20)
    with pytest.raises(StoreError, match="at most 2147483648 bytes"):
        pack_archive({f"arrays/{index}": block for index in range(2**11)})
