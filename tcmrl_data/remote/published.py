"""What lies at an address: a dataset's folder as it is, and beside it further states of it under tags.

    manifest.json tasks.jsonl parts.jsonl parts/…    as in a folder of this disk
    pushed.json                                      which dataset this is; created before anything else
    versions/DIGEST/{manifest.json,…}                manifest and tables of what a tag names; parts are above
    refs/TAG.json                                    what a tag names

Every file is created once and never overwritten, but for a tag that is moved: it is replaced if it still is
what was read. So of two pushes one wins and the other is told, without a server of ours.
"""

import contextlib
import re
from collections.abc import Iterator
from dataclasses import dataclass

from pydantic import Field

from tcmrl_data.foundation.errors import ManifestError, RemoteError
from tcmrl_data.foundation.files import one_line
from tcmrl_data.foundation.records import MAX_JSON_BYTES, Record, parse_json, parse_record
from tcmrl_data.remote.address import TAG_NAME, WEB, Address, parse_address
from tcmrl_data.remote.objects import MissingObjectError, Objects, Version
from tcmrl_data.store.manifest import MANIFEST, MANIFEST_SCHEMA, Manifest
from tcmrl_data.store.tables import SHA256

CLAIM, REFS, VERSIONS = "pushed.json", "refs", "versions"

REF_BYTES, REF_SCHEMA = 4_096, 1

MOST_FOLDERS, MOST_TAGS = 1_000, 10_000
"""Folders that a search for datasets looks into, with a request each, and tags of an address."""


class Ref(Record):
    """What a tag names, or the address itself.

    Attributes:
        root: of the dataset.
        digest: of its manifest.
        time: of the push, in UTC.
    """

    schema_version: int
    root: str = Field(pattern=SHA256)
    digest: str = Field(pattern=SHA256)
    time: str = Field(pattern=r"^[0-9TZ:+.-]{10,40}$")


@dataclass(frozen=True)
class Published:
    """A dataset as its address names it.

    Attributes:
        data: the bytes of its manifest.
        prefix: of the names of manifest and tables.
    """

    manifest: Manifest
    data: bytes
    prefix: str


def version_prefix(digest: str) -> str:
    """Prefix of manifest and tables of a tagged dataset, by the digest of its manifest."""
    return f"{VERSIONS}/{digest[:32]}/"


def ref_name(tag: str) -> str:
    """The file that says what a tag names."""
    return f"{REFS}/{tag}.json"


def read_published(objects: Objects) -> Published:
    """Reads the manifest that an address names.

    Raises:
        RemoteError: there is none, or the server does not give it.
        ManifestError: it is damaged, of another version, or not the one that the tag names.
    """
    address = objects.address
    ref = None
    if address.tag is not None and address.protocol != "hf":
        named = read_ref(objects, ref_name(address.tag))
        if named is None:
            raise RemoteError(f"{address.base} has no tag {address.tag}; {_known(objects)}")
        ref = named[0]
    prefix = "" if ref is None else version_prefix(ref.digest)
    found = read_manifest_at(objects, prefix)
    if found is None:
        raise RemoteError(f"{address} holds no dataset; {_known(objects)}")
    manifest = found.manifest
    if ref is not None and (manifest.digest, manifest.root) != (ref.digest, ref.root):
        raise ManifestError(f"{address}: the tag names root {ref.root[:12]}, and another dataset is there")
    return found


def read_manifest_at(objects: Objects, prefix: str) -> Published | None:
    """The dataset whose manifest has a prefix; None where there is none. Errors as of `read_published`."""
    place = f"{objects.address.base}/{prefix}{MANIFEST}"
    try:
        data, _ = objects.read(prefix + MANIFEST, limit=MAX_JSON_BYTES)
        values = parse_json(data)
    except MissingObjectError:
        return None
    except ValueError as error:
        raise ManifestError(f"{place}: not a manifest ({one_line(error)})") from None
    return Published(parse_record(Manifest, values, place, version=MANIFEST_SCHEMA, data=data), data, prefix)


def _known(objects: Objects) -> str:
    """The end of a message about an address that names nothing."""
    if objects.address.protocol in WEB:
        return "check its spelling"
    tags = sorted(list_tags(objects))
    if tags:
        return f"its tags are {', '.join(f'@{tag}' for tag in tags)}"
    return f"push one with `tcmrl-data push FOLDER {objects.address.base}`"


def list_tags(objects: Objects) -> list[str]:
    """The tags of an address, sorted; nothing on a server that lists nothing.

    Raises:
        RemoteError: the server does not answer, or has too many.
    """
    if objects.address.protocol in WEB:
        return []
    found = (name.removesuffix(".json") for name in objects.folder(REFS)[1] if name.endswith(".json"))
    tags = [tag for tag in found if re.fullmatch(TAG_NAME, tag)]
    if len(tags) > MOST_TAGS:
        raise RemoteError(f"{objects.address.base} has more than {MOST_TAGS:,} tags; name one of them")
    return tags


def find_datasets(address: Address) -> Iterator[Address]:
    """The datasets at or below an address: without a tag, and under every tag.

    Raises:
        RemoteError: the server does not answer, or lists nothing.
    """
    waiting = [at(address, None)]
    for number in range(MOST_FOLDERS):
        if not waiting:
            return
        if number + len(waiting) > MOST_FOLDERS:
            break
        place = waiting.pop()
        objects = Objects(place)
        folders, files = objects.folder()
        if MANIFEST in files:
            yield place
        if REFS in folders or MANIFEST in files:
            yield from (at(place, tag) for tag in list_tags(objects))
            continue
        for name in reversed(folders):
            with contextlib.suppress(RemoteError):  # a name that no address has
                waiting.append(parse_address(f"{place}/{name}"))
    raise RemoteError(f"{address} has more than {MOST_FOLDERS:,} folders; name one below it")


def read_ref(objects: Objects, name: str) -> tuple[Ref, Version] | None:
    """A record of what a name stands for, and its version; None where there is none.

    Raises:
        RemoteError: the server does not give it.
        ManifestError: the file is no such record.
    """
    try:
        data, version = objects.read(name, limit=REF_BYTES)
        values = parse_json(data)
    except MissingObjectError:
        return None
    except ValueError as error:
        raise ManifestError(f"{objects.address.base}/{name}: not JSON ({one_line(error)})") from None
    return parse_record(Ref, values, f"{objects.address.base}/{name}", version=REF_SCHEMA), version


def at(address: Address, tag: str | None) -> Address:
    """The address of a tag."""
    return Address(address.protocol, address.place, tag)
