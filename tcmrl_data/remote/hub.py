"""Pushing to the Hugging Face Hub: parts in commits of a hundred, tables, card and manifest in one.

Every commit names the one before it, so that of two pushes one wins and the other is told. Files of the Hub
have digests in its listing, which are compared.
"""

import contextlib
import hashlib
import os
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from tcmrl_data.foundation.errors import MissingPackageError, RemoteError
from tcmrl_data.foundation.files import one_line, printable
from tcmrl_data.remote.address import Address
from tcmrl_data.remote.files import Progress, counted
from tcmrl_data.remote.local import LocalDataset, PushReport, batches
from tcmrl_data.remote.objects import Objects
from tcmrl_data.remote.published import at, read_manifest_at
from tcmrl_data.store.part_table import PartEntry
from tcmrl_data.store.tables import part_file

COMMIT_FILES = 100
"""Parts in one commit."""

FOLDER_FILES, ALL_FILES = 10_000, 50_000
"""Entries of a folder that the Hub accepts, and files of a repository above which it advises against it."""

KIND = "dataset"
CONFLICT = (409, 412)


def push_to_hub(
    local: LocalDataset,
    address: Address,
    *,
    describe: Callable[[Path], None],
    move: bool,
    progress: Progress | None,
) -> PushReport:
    """Pushes a dataset to a repository of the Hub, which is made if there is none.

    Args:
        local: the dataset.
        address: of the repository, with the tag that names this state of it.
        describe: writes the card, and what it names, into a folder.
        move: the tag may name another dataset already.
        progress: called with bytes that are there, and bytes in all.

    Raises:
        RemoteError: the repository or the tag holds another dataset, or the Hub refuses something.
        StoreError: a part is missing or damaged.
    """
    return _HubPush(local, address, describe).run(move, progress)


class _HubPush:
    def __init__(self, local: LocalDataset, address: Address, describe: Callable[[Path], None]) -> None:
        try:
            import huggingface_hub
            import huggingface_hub.errors
            import huggingface_hub.hf_api
            import huggingface_hub.utils
        except ImportError as error:
            raise MissingPackageError(
                f"hf:// needs a package that is not installed ({one_line(error)}); install it with "
                "`pip install 'tcmrl[remote]'`"
            ) from None
        self._hub = huggingface_hub
        self._local, self._address, self._describe = local, address, describe
        self._repository = address.place.partition("/")[2]
        self._api = huggingface_hub.HfApi(endpoint=os.environ.get("HF_ENDPOINT"))
        self._head = ""

    def run(self, move: bool, progress: Progress | None) -> PushReport:
        """Sends what the repository lacks."""
        warning = self._warning()
        with self._named_errors():
            self._head = self._find_head()
            tags = {tag.name for tag in self._refs().tags} if self._address.tag else set()
        moved_from = self._named(tags, move)
        if moved_from == self._local.manifest.root:
            return self._report([], 0, None, warning)
        with self._named_errors():
            sent = self._send_parts(progress)
            self._send_description()
            files = self._local.files
            self._commit(files, f"Tables and manifest of root {self._local.manifest.root[:12]}")
            if self._address.tag:
                self._name(self._address.tag, replace=self._address.tag in tags)
        return self._report(sent, sum(map(len, files.values())), moved_from, warning)

    def _report(
        self, sent: list[PartEntry], more: int, moved_from: str | None, warning: str | None
    ) -> PushReport:
        root, number = self._local.manifest.root, len(self._local.entries)
        num_bytes = sum(entry.size for entry in sent) + more
        return PushReport(str(self._address), root, number, len(sent), num_bytes, moved_from, warning)

    def _warning(self) -> str | None:
        """What the Hub may not like of the dataset.

        Raises:
            RemoteError: what it refuses.
        """
        paths = [PurePosixPath(part_file(entry.key)) for entry in self._local.entries]
        folders = {path.parent for path in paths}
        entries = Counter(path.parent for path in paths) + Counter(folder.parent for folder in folders)
        if max(entries.values(), default=0) > FOLDER_FILES:
            raise RemoteError(
                f"{self._address}: a folder of the Hub has at most {FOLDER_FILES:,} entries, and "
                f"{entries.most_common(1)[0][0]} would have more; push it to a bucket, or fewer tasks"
            )
        if len(paths) <= ALL_FILES:
            return None
        return f"the Hub advises against more than {ALL_FILES:,} files, and this dataset has {len(paths):,}"

    def _find_head(self) -> str:
        """The newest commit of the repository."""
        try:
            return str(self._api.repo_info(self._repository, repo_type=KIND).sha)
        except self._hub.errors.RepositoryNotFoundError:
            self._api.create_repo(self._repository, repo_type=KIND, exist_ok=True)
            return str(self._api.repo_info(self._repository, repo_type=KIND).sha)

    def _refs(self) -> Any:
        return self._api.list_repo_refs(self._repository, repo_type=KIND)

    def _named(self, tags: set[str], move: bool) -> str | None:
        """The root that the tag names, or without a tag the repository; None where there is none.

        Raises:
            RemoteError: it is another one, and must stay.
        """
        tag = self._address.tag
        if tag is not None and tag not in tags:
            return None
        found = read_manifest_at(Objects(self._address), "")
        if found is None or found.manifest.digest == self._local.manifest.digest:
            return found.manifest.root if found else None
        root, mine = found.manifest.root[:12], self._local.manifest.root[:12]
        if tag is None:
            raise RemoteError(
                f"{self._address} is that of a dataset with root {root}, and yours has {mine}; push it there "
                "under a tag (--tag NAME), or to another address"
            )
        if not move:
            raise RemoteError(
                f"{self._address} names root {root}; to have it name root {mine} from now on, say --move, or "
                "choose another tag"
            )
        return found.manifest.root

    def _send_parts(self, progress: Progress | None) -> list[PartEntry]:
        """Commits the parts that the repository lacks, and returns them."""
        missing = self._missing()
        total, lacking = (sum(one.size for one in group) for group in (self._local.entries, missing))
        say, done = counted(progress, total, total - lacking), 0
        for group in batches(missing, COMMIT_FILES):
            done += len(group)
            parts = {part_file(entry.key): self._local.content(entry) for entry in group}
            self._commit(parts, f"Parts {done - len(group) + 1:,} to {done:,} of {len(missing):,}")
            say(sum(entry.size for entry in group))
        return missing

    def _send_description(self) -> None:
        """Commits the card and what it names."""
        with tempfile.TemporaryDirectory() as folder:
            self._describe(Path(folder))
            files = sorted(path for path in Path(folder).rglob("*") if path.is_file())
            for first in range(0, len(files), COMMIT_FILES):
                group = files[first : first + COMMIT_FILES]
                self._commit({str(path.relative_to(folder)): str(path) for path in group}, "Card and viewer")

    def _missing(self) -> list[PartEntry]:
        """The parts that the repository lacks, by one listing.

        Raises:
            RemoteError: another file has the name of one.
        """
        tree = self._api.list_repo_tree(self._repository, recursive=True, revision=self._head, repo_type=KIND)
        listed = {file.path: file for file in tree if isinstance(file, self._hub.hf_api.RepoFile)}
        missing = []
        for entry in self._local.entries:
            name = part_file(entry.key)
            if name not in listed:
                missing.append(entry)
            elif not self._is_equal(entry, listed[name]):
                raise RemoteError(
                    f"{at(self._address, None)}/{name} holds other bytes than the file of "
                    f"{self._local.folder}; push to another address"
                )
        return missing

    def _is_equal(self, entry: PartEntry, file: Any) -> bool:
        if file.size != entry.size:
            return False
        if file.lfs is not None:
            return bool(file.lfs.sha256 == entry.sha256)
        blob = b"blob %d\0" % entry.size + self._local.content(entry)
        return bool(hashlib.sha1(blob, usedforsecurity=False).hexdigest() == file.blob_id)

    def _commit(self, files: Mapping[str, bytes | str], message: str) -> None:
        """Adds files, by content or path, on top of the newest commit that was seen."""
        operations = [self._hub.CommitOperationAdd(name, data) for name, data in files.items()]
        with self._without_bars():
            made = self._api.create_commit(
                self._repository,
                operations,
                commit_message=message,
                repo_type=KIND,
                parent_commit=self._head,
            )
        self._head = str(made.oid)

    @contextlib.contextmanager
    def _without_bars(self) -> Iterator[None]:
        """Keeps the client's own progress from the terminal."""
        bars = self._hub.utils
        if bars.are_progress_bars_disabled():
            yield
            return
        bars.disable_progress_bars()
        try:
            yield
        finally:
            bars.enable_progress_bars()

    def _name(self, tag: str, *, replace: bool) -> None:
        if replace:
            self._api.delete_tag(self._repository, tag=tag, repo_type=KIND)
        self._api.create_tag(self._repository, tag=tag, revision=self._head, repo_type=KIND)

    @contextlib.contextmanager
    def _named_errors(self) -> Iterator[None]:
        """Turns errors of the Hub's client into one line with place and remedy."""
        try:
            yield
        except self._hub.errors.HfHubHTTPError as error:
            status = error.response.status_code if error.response is not None else None
            if status in CONFLICT:
                raise RemoteError(
                    f"{self._address} was changed by another push meanwhile; run the same command again, or "
                    "choose another tag"
                ) from None
            remedy = (
                "log in by `hf auth login`, and check what the token allows"
                if status in (401, 403)
                else ("run the same command again to continue")
            )
            raise RemoteError(f"{self._address}: the Hub answers {status}; {remedy}") from None
        except (OSError, ValueError, RuntimeError) as error:
            words = printable(" ".join(one_line(error).split())[:300])
            raise RemoteError(f"{self._address}: {words}; run the same command again to continue") from None
