"""Files below an address, through obstore: read up to a limit, created once, replaced if unchanged, listed.

A request is made again where it may succeed then. Never more of an answer is taken than the caller allows.
"""

import asyncio
import contextlib
import functools
import hashlib
import os
import re
import threading
import time
from collections.abc import Awaitable, Callable, Coroutine, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from zlib import crc32

from tcmrl_data.foundation.errors import MissingPackageError, RemoteError
from tcmrl_data.foundation.files import one_line, printable
from tcmrl_data.foundation.machine import resident_memory, size
from tcmrl_data.remote.address import WEB, Address

REQUESTS = 16
"""Requests that are under way at the same time."""

PAUSES = (0.3, 0.6, 1.2, 2.5, 5.0, 10.0)
"""Seconds before a request is made again; with each pause up to twice as long, by the file's name."""

DAMAGED_AGAIN = 2
"""Times that a file is asked for again whose bytes are not the recorded ones: most damage stays."""

SILENCE = 30
"""Seconds without a byte after which a request counts as lost."""

LONGEST = 3_600
"""Seconds that a request may take in all."""

SLOWEST, PATIENCE = 1_000, 60.0
"""A transfer below this many bytes a second, after this many seconds, counts as lost."""

PASSING = (400, 408, 409, 425, 429)
"""Answers of the kind 4xx after which a request may succeed if it is made again; S3 says 400 where bytes of a
body were lost on the way."""

SETTINGS = {"s3": "AWS", "gs": "GOOGLE", "az": "AZURE"}
"""How the variables of the environment begin that name the credentials of a protocol."""

MOST_FILES = 2_000_000
"""Files that a listing may name; a dataset has a million parts at most."""

LISTED, LISTED_BYTES = 1_000, 256 * 2**20
"""Files in one answer of a listing, and bytes by which this process may grow while it arrives."""

GLANCE = 0.02
"""Seconds between two looks at an answer that arrives."""

_STATUS = re.compile(r"status code: (\d{3})")

_TOKEN = re.compile(r"token request|/api/token|<Code>[A-Za-z]*Token")
"""A token that is refused, or asked of the machine itself, since the environment names no credentials."""

Item = TypeVar("Item")
Made = TypeVar("Made")
Version = Mapping[str, str | None]
"""Which state of a file was seen: its ETag, and its generation where the store has one."""


class MissingObjectError(RemoteError):
    """A file that the server does not have."""


class OversizeError(RemoteError):
    """A server sends more than the caller allows."""


class DamageError(RemoteError):
    """Bytes that arrived are not those that the dataset's table names."""


@dataclass(frozen=True)
class Listed:
    """A file as a listing names it.

    Attributes:
        size: in bytes.
        md5: of the content in hexadecimal; None where the listing does not tell it.
    """

    size: int
    md5: str | None


class Objects:
    """The files below an address, by their paths relative to it.

    Example:
        >>> Objects(parse_address("s3://bucket/point-robot")).listing("parts/")  # doctest: +SKIP
    """

    def __init__(self, address: Address) -> None:
        self.address = address
        self._process = os.getpid()
        self._store = _make_store(address)

    def fetch(
        self,
        name: str,
        file: Path,
        *,
        limit: int,
        sha256: str,
        prefix: bool = False,
        say: Callable[[int], None] | None = None,
    ) -> None:
        """Writes a remote file into a file of this disk, which is there in part after an error.

        Args:
            name: the remote file.
            file: the local file.
            limit: bytes that it may have.
            sha256: of the bytes that are wanted.
            prefix: the first `limit` bytes are wanted, and there may be more.
            say: called with numbers of bytes as they arrive; negative for those that have to be sent again.

        Raises:
            MissingObjectError: there is no such file.
            OversizeError: it is larger.
            DamageError: it has other bytes.
            RemoteError: the server does not give it.
        """
        place = f"{self.address.base}/{name}"

        def get(obstore: Any) -> None:
            digest, received = hashlib.sha256(), 0
            try:
                with file.open("wb") as opened:
                    for piece in self._pieces(obstore.get(self._store, name), place, limit, prefix=prefix):
                        opened.write(piece)
                        digest.update(piece)
                        received += len(piece)
                        if say:
                            say(len(piece))
                if digest.hexdigest() != sha256:
                    raise DamageError(
                        f"{place} does not have the recorded sha256: it was damaged or replaced; push it "
                        "again from a sound copy"
                    )
            except BaseException:
                if say:
                    say(-received)
                raise

        self._attempt(name, get)

    def read(self, name: str, *, limit: int) -> tuple[bytes, Version]:
        """Content and version of a small remote file; errors as of `fetch`."""

        def get(obstore: Any) -> tuple[bytes, Version]:
            found = obstore.get(self._store, name)
            pieces = self._pieces(found, f"{self.address.base}/{name}", limit)
            return b"".join(pieces), {key: found.meta[key] for key in ("e_tag", "version")}

        return self._attempt(name, get)

    def _pieces(self, found: Any, place: str, limit: int, *, prefix: bool = False) -> Iterator[bytes]:
        """The pieces of an answer as they arrive, up to a limit; errors as of `fetch`."""
        if found.meta["size"] > limit and not prefix:
            raise OversizeError(
                f"{place} has {found.meta['size']} bytes, more than the {limit} that it may have"
            )
        received, began = 0, time.monotonic()
        for piece in found.stream(min_chunk_size=1):
            if received + len(piece) > limit and not prefix:
                raise OversizeError(f"{place} has more than the {limit} bytes that it may have")
            yield bytes(piece)[: limit - received]
            received += len(piece)
            if received >= limit:
                return
            seconds = time.monotonic() - began
            if seconds > PATIENCE and received < SLOWEST * seconds:
                raise TimeoutError(f"{received} bytes arrived in {seconds:.0f} s")

    def create(self, name: str, data: bytes) -> bool:
        """Creates a remote file unless there is one of its name.

        Returns:
            False if there is one already, which stays as it is; it may be of an earlier attempt of this call.

        Raises:
            RemoteError: the server does not take it.
        """
        return self._put(name, data, "create")

    def replace(self, name: str, data: bytes, version: Version) -> bool:
        """Replaces a remote file if it still has the version that was read; else returns False.

        Raises:
            RemoteError: the server does not take it.
        """
        return self._put(name, data, {key: value for key, value in version.items() if value})

    def _put(self, name: str, data: bytes, mode: Any) -> bool:
        if self.address.protocol in WEB:
            raise RemoteError(f"{self.address}: web servers are only read")

        def put(obstore: Any) -> bool:
            try:
                made = obstore.put(self._store, name, data, mode=mode, use_multipart=False)
            except (obstore.exceptions.AlreadyExistsError, obstore.exceptions.PreconditionError):
                return False
            arrived = _md5_of(made["e_tag"])
            if arrived not in (None, hashlib.md5(data, usedforsecurity=False).hexdigest()):
                obstore.delete(self._store, name)
                raise DamageError(f"{self.address.base}/{name} arrives with other bytes than were sent")
            return True

        return self._attempt(name, put)

    def listing(self, folder: str = "") -> dict[str, Listed]:
        """The files below a folder, by their paths relative to the address; one request a thousand files.

        Raises:
            RemoteError: the server lists nothing.
        """
        self._check_lists()

        async def find(obstore: Any) -> dict[str, Listed]:
            files: dict[str, Listed] = {}
            number, stream = 0, obstore.list(self._store, folder or None, chunk_size=LISTED)
            with contextlib.suppress(StopAsyncIteration):
                while True:
                    piece = await self._bounded(anext(stream), folder)
                    files |= {
                        found["path"]: Listed(found["size"], _md5_of(found["e_tag"])) for found in piece
                    }
                    number += len(piece)
                    if number > MOST_FILES:
                        raise OversizeError(
                            f"{self.address.base}/{folder} has more than {MOST_FILES:,} files"
                        )
            return files

        return self._attempt(folder, lambda obstore: _awaited(find(obstore)))

    def folder(self, folder: str = "") -> tuple[list[str], list[str]]:
        """Names of the folders and of the files in a folder, sorted; errors as of `listing`."""
        self._check_lists()

        async def look(obstore: Any) -> tuple[list[str], list[str]]:
            answer = obstore.list_with_delimiter_async(self._store, folder or None)
            found = await self._bounded(answer, folder)
            paths = (found["common_prefixes"], [file["path"] for file in found["objects"]])
            folders, files = (sorted(path.rpartition("/")[2] for path in group) for group in paths)
            return folders, files

        return self._attempt(folder, lambda obstore: _awaited(look(obstore)))

    async def _bounded(self, answer: Awaitable[Made], folder: str) -> Made:
        """Waits for an answer of a listing, which obstore would read without end.

        Raises:
            OversizeError: it takes too long, or too much memory.
        """
        waiting, began, before = asyncio.ensure_future(answer), time.monotonic(), resident_memory()
        try:
            while not (await asyncio.wait([waiting], timeout=GLANCE))[0]:
                if time.monotonic() > began + PATIENCE or resident_memory() > before + LISTED_BYTES:
                    raise OversizeError(
                        f"{self.address.base}/{folder} has a listing that does not end within "
                        f"{PATIENCE:.0f} s and {size(LISTED_BYTES)}; name a dataset itself"
                    )
            return waiting.result()
        finally:
            waiting.cancel()

    def _check_lists(self) -> None:
        if self.address.protocol in WEB:
            raise RemoteError(f"{self.address}: web servers list nothing; name a dataset itself")

    def _attempt(self, name: str, work: Callable[[Any], Made]) -> Made:
        """Makes a request, again where it may succeed then."""
        obstore = _obstore(self.address.protocol)
        place = f"{self.address.base}/{name}".rstrip("/")
        if os.getpid() != self._process:
            raise RemoteError(
                f"{place}: a forked process has no network here; fetch the parts before it is forked "
                "(`Dataset.fetch`), or start it by spawn"
            )
        spread = 1 + crc32(name.encode()) % 100 / 100
        refused = (obstore.exceptions.PermissionDeniedError, obstore.exceptions.UnauthenticatedError)
        for attempt in range(len(PAUSES) + 1):
            try:
                return work(obstore)
            except FileNotFoundError:
                raise MissingObjectError(f"{place} does not exist") from None
            except refused as error:
                raise RemoteError(f"{place}: {_reason(error)}; {_credentials(self.address)}") from None
            except DamageError:  # on the way, or there
                if attempt >= DAMAGED_AGAIN:
                    raise
            except (obstore.exceptions.BaseError, TimeoutError) as error:
                if attempt == len(PAUSES) or not _may_pass(error):
                    tried = f" after {attempt + 1} attempts" if attempt else ""
                    remedy = (
                        _credentials(self.address)
                        if _TOKEN.search(str(error))
                        else "check address and network"
                    )
                    raise RemoteError(
                        f"{place}: {_reason(error)}{tried}; {remedy}, then run the same command again to "
                        "continue"
                    ) from None
            time.sleep(PAUSES[attempt] * spread)
        raise AssertionError("the last attempt returns or raises")


def _obstore(protocol: str) -> Any:
    try:
        import obstore
    except ImportError as error:
        raise MissingPackageError(
            f"{protocol}:// needs a package that is not installed ({one_line(error)}); install it with "
            "`pip install 'tcmrl[remote]'`"
        ) from None
    return obstore


def _make_store(address: Address) -> Any:
    """The store of an address; credentials and endpoints are those of the environment."""
    obstore = _obstore(address.protocol)
    client: dict[str, Any] = {
        "allow_http": True,
        "connect_timeout": f"{SILENCE}s",
        "read_timeout": f"{SILENCE}s",
        "timeout": f"{LONGEST}s",
    }
    retries = {"max_retries": 0}  # those of `Objects` are the only ones
    base = address.base
    if address.protocol == "hf":
        host = os.environ.get("HF_ENDPOINT", "https://huggingface.co").rstrip("/")
        base = f"{host}/{address.place}/resolve/{address.tag or 'main'}"
        if token := _hub_token():
            client["default_headers"] = {"Authorization": f"Bearer {token}"}
    try:
        if address.protocol in WEB:
            return obstore.store.HTTPStore.from_url(base, client_options=client, retry_config=retries)
        return obstore.store.from_url(base, client_options=client, retry_config=retries)
    except (obstore.exceptions.BaseError, ValueError) as error:
        raise RemoteError(f"{address.base}: {_reason(error)}; {_credentials(address)}") from None


def _credentials(address: Address) -> str:
    """What to do where a server refuses."""
    words = "check the credentials in the environment, and what they allow"
    if address.protocol in WEB:
        return words
    return f"{words}; set {SETTINGS[address.protocol]}_SKIP_SIGNATURE=true for a bucket that is open to all"


def _hub_token() -> str | None:
    """The user's token for the Hub, where huggingface_hub is installed; other servers never get it."""
    try:
        from huggingface_hub import get_token
    except ImportError:
        return None
    token: str | None = get_token()
    return token


def _md5_of(e_tag: str | None) -> str | None:
    """The MD5 of a listed file where the store tells it; an ETag of several pieces or of KMS is none."""
    tag = (e_tag or "").strip('"')
    return tag if re.fullmatch("[0-9a-f]{32}", tag) else None


def _may_pass(error: Exception) -> bool:
    """Whether the same request may succeed later."""
    found = _STATUS.search(str(error))
    if found is None:
        return not _TOKEN.search(str(error))
    return not 400 <= int(found[1]) < 500 or int(found[1]) in PASSING


def _reason(error: Exception) -> str:
    """What went wrong, without the source's own words, which are a page long."""
    text = str(error).partition("\n\nDebug source")[0]
    status = re.search(r"status code: ([^:]*)", text)
    code = re.search(r"<Code>([A-Za-z0-9]{1,60})</Code>", text)
    if status:
        text = f"the server answers {status[1]}{f' ({code[1]})' if code else ''}"
    return printable(" ".join(text.split())[:300]) or type(error).__name__


def _awaited(work: Coroutine[Any, Any, Made]) -> Made:
    """The result of a coroutine; Ctrl-C ends it."""
    waiting = asyncio.run_coroutine_threadsafe(work, _loop(os.getpid()))
    try:
        return waiting.result()
    finally:
        waiting.cancel()


@functools.cache
def _loop(process: int) -> asyncio.AbstractEventLoop:
    """An event loop of a process in a thread of its own: a notebook runs another one in its main thread."""
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, name=f"listing of {process}", daemon=True).start()
    return loop


def each(work: Callable[[Item], None], items: list[Item], *, workers: int = REQUESTS) -> None:
    """Calls a function for all items, several at a time; the first error, or Ctrl-C, leaves out the rest."""
    pool = ThreadPoolExecutor(max(1, min(workers, len(items))))
    try:
        for done in [pool.submit(work, item) for item in items]:
            done.result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
