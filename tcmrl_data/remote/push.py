"""Pushing: parts, tables, manifest and tag of a dataset, in the order in which a build writes them.

A push that was stopped goes on when the same command is given again: one listing says what is there. Where
the store tells the MD5 of a file, it is compared; elsewhere what was there before is read back. Only bytes
whose sha256 the dataset's own table names are sent.
"""

import datetime
import hashlib
import tempfile
from collections.abc import Callable
from pathlib import Path

from tcmrl_data.foundation.errors import RemoteError
from tcmrl_data.foundation.records import record_bytes, sha256
from tcmrl_data.remote.address import Address, parse_address
from tcmrl_data.remote.files import Progress, counted
from tcmrl_data.remote.hub import push_to_hub
from tcmrl_data.remote.local import MEMORY, LocalDataset, PushPlan, PushReport, read_local
from tcmrl_data.remote.objects import (
    LISTED,
    REQUESTS,
    DamageError,
    Listed,
    Objects,
    OversizeError,
    Version,
    each,
)
from tcmrl_data.remote.published import (
    CLAIM,
    REF_SCHEMA,
    Ref,
    at,
    read_manifest_at,
    read_ref,
    ref_name,
    version_prefix,
)
from tcmrl_data.store.manifest import dataset_folder
from tcmrl_data.store.part_table import PartEntry
from tcmrl_data.store.tables import PARTS, part_file


def push_folder(
    folder: Path,
    url: str,
    *,
    tag: str | None,
    move: bool,
    describe: Callable[[Path], None],
    progress: Progress | None,
) -> PushReport:
    """Copies the dataset of a folder to an address; for the Hub, `describe` writes a card into a folder.

    Raises:
        RemoteError: the address or the tag names another dataset, or the server refuses something.
        ManifestError: there is no dataset in the folder, or it names no licence or citation.
        StoreError: a part is missing or damaged.
    """
    address = _target(url, tag)
    local = read_local(folder)
    if address.protocol == "hf":
        return push_to_hub(local, address, describe=describe, move=move, progress=progress)
    return _Push(local, Objects(at(address, None)), address.tag).run(move, progress)


def plan_push(dataset: str | Path, url: str, *, tag: str | None = None, move: bool = False) -> PushPlan:
    """What `push_dataset` with the same arguments would send to a bucket. Nothing is sent, or read back.

    Raises:
        RemoteError: the address or the tag names another dataset, the server refuses something, or it is the
            Hub.
        ManifestError: there is no dataset in the folder, or it names no licence or citation.

    Example:
        >>> plan_push("data/point-robot", "s3://bucket/point-robot").missing_bytes  # doctest: +SKIP
    """
    address = _target(url, tag)
    if address.protocol == "hf":
        raise RemoteError(f"{address}: only what a push to a bucket takes is planned; omit --plan")
    local = read_local(dataset_folder(dataset))
    return _Push(local, Objects(at(address, None)), address.tag).plan(move)


def _target(url: str, tag: str | None) -> Address:
    """The address that a push goes to, with its tag."""
    address = parse_address(url)
    if address.tag is not None:
        raise RemoteError(f"{address}: name the tag by --tag {address.tag}")
    if address.protocol in ("http", "https"):
        raise RemoteError(f"{address}: a dataset is only read by {address.protocol}://; push it to a bucket")
    return parse_address(f"{address}@{tag}") if tag else address


class _Push:
    """A push into a bucket."""

    def __init__(self, local: LocalDataset, objects: Objects, tag: str | None) -> None:
        self._local, self._objects, self._tag = local, objects, tag
        self._ref = Ref(
            schema_version=REF_SCHEMA,
            root=local.manifest.root,
            digest=local.manifest.digest,
            time=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        )

    def run(self, move: bool, progress: Progress | None) -> PushReport:
        """Sends what the address lacks."""
        named = self._named(move)
        before, version = named or (None, None)
        if before is not None and before.digest == self._ref.digest:
            return self._report([], 0, None)
        if self._tag is None:
            self._claim()
        sent = self._send_parts(progress)
        prefix = version_prefix(self._ref.digest) if self._tag else ""
        files = {prefix + name: data for name, data in self._local.files.items()}
        more = sum(len(data) for name, data in files.items() if self._put(name, data, sha256(data)))
        if self._tag is not None:
            self._name(self._tag, version)
        return self._report(sent, more, before.root if before else None)

    def plan(self, move: bool) -> PushPlan:
        """What `run` would do."""
        named, entries = self._named(move), self._local.entries
        address, root = str(at(self._objects.address, self._tag)), self._ref.root
        if named and named[0].digest == self._ref.digest:
            return PushPlan(address, root, len(entries), 0, 0, requests=1)
        listed = self._objects.listing(PARTS)
        missing = [entry for entry in entries if part_file(entry.key) not in listed]
        found = [listed[name] for entry in entries if (name := part_file(entry.key)) in listed]
        files = self._local.files.values()
        looks = 1 + max(1, -(-len(listed) // LISTED)) + sum(there.md5 is None for there in found)
        return PushPlan(
            address,
            root,
            len(entries),
            len(missing),
            sum(entry.size for entry in missing) + sum(map(len, files)),
            requests=looks + len(missing) + len(files) + 1,  # the claim, or the tag
        )

    def _report(self, sent: list[PartEntry], more: int, moved_from: str | None) -> PushReport:
        num_bytes = sum(entry.size for entry in sent) + more
        address = str(at(self._objects.address, self._tag))
        return PushReport(address, self._ref.root, len(self._local.entries), len(sent), num_bytes, moved_from)

    def _named(self, move: bool) -> tuple[Ref, Version] | None:
        """What the tag, or the address without one, names already.

        Raises:
            RemoteError: another dataset, which it must go on to name.
        """
        if self._tag is None:
            found = read_manifest_at(self._objects, "")
            if found is None:
                return None
            self._refuse(found.manifest.root, found.manifest.digest)
            return self._ref, {}
        named = read_ref(self._objects, ref_name(self._tag))
        if named and named[0].digest != self._ref.digest and not move:
            raise RemoteError(
                f"{at(self._objects.address, self._tag)} names root {named[0].root[:12]} since "
                f"{named[0].time}; to have it name root {self._ref.root[:12]} from now on, say --move, or "
                "choose another tag"
            )
        return named

    def _refuse(self, root: str, digest: str) -> None:
        if digest != self._ref.digest:
            raise RemoteError(
                f"{self._objects.address} is that of a dataset with root {root[:12]}, and yours has "
                f"{self._ref.root[:12]}; push it there under a tag (--tag NAME), or to another address"
            )

    def _claim(self) -> None:
        """Makes the address that of this dataset, before anything is sent."""
        if not self._objects.create(CLAIM, record_bytes(self._ref)):
            held = read_ref(self._objects, CLAIM)
            if held is not None:
                self._refuse(held[0].root, held[0].digest)

    def _name(self, tag: str, version: Version | None) -> None:
        """Lets a tag name this dataset, unless another push was faster."""
        name, data = ref_name(tag), record_bytes(self._ref)
        if (
            self._objects.create(name, data)
            if version is None
            else self._objects.replace(name, data, version)
        ):
            return
        found = read_ref(self._objects, name)
        if found is None or found[0].digest != self._ref.digest:
            root = found[0].root[:12] if found else "unknown"
            raise RemoteError(
                f"{at(self._objects.address, tag)} was given to a dataset with root {root} meanwhile; choose "
                "another tag, or push again with --move"
            )

    def _put(self, name: str, data: bytes, digest: str) -> bool:
        """Creates a file; False if it is there.

        Raises:
            RemoteError: another file is there.
        """
        is_new = self._objects.create(name, data)
        if not is_new and not self._is_there(name, len(data), digest):
            self._refuse_file(name)
        return is_new

    def _is_there(self, name: str, size: int, digest: str) -> bool:
        """Whether a remote file has the bytes of a digest, which takes to read it."""
        with tempfile.TemporaryDirectory() as staging:
            try:
                self._objects.fetch(name, Path(staging) / "file", limit=size, sha256=digest)
            except (DamageError, OversizeError):
                return False
        return True

    def _refuse_file(self, name: str) -> None:
        raise RemoteError(
            f"{self._objects.address}/{name} holds other bytes than the file of {self._local.folder}; push "
            "to another address, or delete that file if nothing names it"
        )

    def _send_parts(self, progress: Progress | None) -> list[PartEntry]:
        """Sends the parts that the address lacks, and returns them."""
        missing = self._missing()
        if missing:
            total, lacking = (sum(one.size for one in group) for group in (self._local.entries, missing))
            say = counted(progress, total, total - lacking)
            workers = MEMORY // max(entry.size for entry in missing)
            each(lambda entry: self._send(entry, say), missing, workers=min(REQUESTS, max(1, workers)))
        return missing

    def _send(self, entry: PartEntry, say: Callable[[int], None]) -> None:
        self._put(part_file(entry.key), self._local.content(entry), entry.sha256)
        say(entry.size)

    def _missing(self) -> list[PartEntry]:
        """The parts that the address lacks, by one listing.

        Raises:
            RemoteError: another part has the name of one.
        """
        listed = self._objects.listing(PARTS)

        def compare(entry: PartEntry) -> None:
            name = part_file(entry.key)
            if not self._is_equal(entry, listed[name]):
                self._refuse_file(name)

        each(compare, [entry for entry in self._local.entries if part_file(entry.key) in listed])
        return [entry for entry in self._local.entries if part_file(entry.key) not in listed]

    def _is_equal(self, entry: PartEntry, there: Listed) -> bool:
        if there.size != entry.size or there.md5 is None:
            return there.size == entry.size and self._is_there(part_file(entry.key), entry.size, entry.sha256)
        return hashlib.md5(self._local.content(entry), usedforsecurity=False).hexdigest() == there.md5
