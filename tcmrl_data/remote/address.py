"""Addresses of datasets: `s3://bucket/folder`, `https://host/folder`, `hf://datasets/owner/name`, `…@TAG`."""

import re
from dataclasses import dataclass
from typing import Self, TypeGuard

from tcmrl_data.foundation.errors import RemoteError
from tcmrl_data.foundation.files import printable

PROTOCOLS = ("s3", "gs", "az", "http", "https", "hf")
WEB = ("http", "https", "hf")
"""Protocols by which files are read as web pages: nothing can be listed."""

TAG_NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}"

_URL = re.compile(r"([a-z][a-z0-9+.-]*)://(.*)", re.DOTALL)
_PLACE = re.compile(r"[A-Za-z0-9._~:\[\]-]+(?:/[A-Za-z0-9._~+=,!()'-]+)*")
_HUB_PLACE = re.compile(r"datasets(?:/[A-Za-z0-9._-]{1,96}){2}")


@dataclass(frozen=True)
class Address:
    """Where a dataset lies beyond this disk. It stands where a path may stand.

    Attributes:
        protocol: one of `PROTOCOLS`.
        place: what follows `://`, without the tag.
        tag: a name that somebody gave to one state of a dataset; on the Hub a tag, branch or commit.
    """

    protocol: str
    place: str
    tag: str | None = None

    def __str__(self) -> str:
        return f"{self.base}@{self.tag}" if self.tag else self.base

    def __fspath__(self) -> str:
        return str(self)

    @property
    def base(self) -> str:
        """The address without the tag."""
        return f"{self.protocol}://{self.place}"

    @property
    def name(self) -> str:
        """The last component."""
        return self.place.rpartition("/")[2]

    def resolve(self) -> Self:
        """The address itself, which depends on no current folder."""
        return self


def is_url(path: object) -> TypeGuard[str]:
    """Whether a text is meant as an address."""
    return isinstance(path, str) and _URL.fullmatch(path) is not None


def parse_address(url: str | Address) -> Address:
    """An address, given its text.

    Raises:
        RemoteError: an unknown protocol, or characters that an address does not have.
    """
    if isinstance(url, Address):
        return url
    match = _URL.fullmatch(url)
    shown = printable(url)[:200]
    if match is None or match[1] not in PROTOCOLS:
        known = ", ".join(f"{protocol}://" for protocol in PROTOCOLS)
        raise RemoteError(f"{shown} is no address of a dataset; addresses begin with {known}")
    place, tag = match[2].rstrip("/"), None
    if "@" in place:
        place, _, tag = place.rpartition("@")
        if "@" in place or "/" in tag:
            raise RemoteError(f"{shown} holds an @ that begins no tag; give passwords by the environment")
        if not re.fullmatch(TAG_NAME, tag):
            raise RemoteError(f"{shown}: a tag is 1 to 64 letters, digits, dots, dashes and underscores")
    parts = place.split("/")
    if not _PLACE.fullmatch(place) or not {"", ".", ".."}.isdisjoint(parts):
        raise RemoteError(
            f"{shown} is no address of a dataset; after the server or bucket write folders of letters, "
            "digits and . _ ~ - alone"
        )
    if match[1] == "hf" and not _HUB_PLACE.fullmatch(place):
        raise RemoteError(f"{shown} is no dataset of the Hub; write it as hf://datasets/OWNER/NAME")
    return Address(match[1], place, tag)
