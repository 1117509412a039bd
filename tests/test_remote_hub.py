"""Datasets of the Hugging Face Hub: its own client against a stub of the routes that are used.

And the page of buckets and the Hub, against servers of this machine.
"""

# ruff: noqa: F811 # fixtures of another file
import dataclasses
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("obstore", reason="needs the extra `remote`")
pytest.importorskip("huggingface_hub", reason="needs the extra `remote`")
pytest.importorskip("pyarrow", reason="needs the extra `parquet`")

import huggingface_hub
import huggingface_hub.constants

from tcmrl_data import open_dataset, pull_dataset, push_dataset, verify_dataset
from tcmrl_data.foundation.errors import RemoteError
from tcmrl_data.remote import hub
from tcmrl_data.store.manifest import MANIFEST
from tests.hub_stub import HubStub
from tests.page_blocks import Command, blocks, commands
from tests.remotes import (  # noqa: F401 # fixtures
    Proxy,
    folder_server,
    frozen,
    last,
    own_fetched_parts,
    sealed_files,
    server,
)
from tests.test_pages_run import demo, run  # noqa: F401 # fixture

URL = "hf://datasets/owner/name"

pytestmark = pytest.mark.filterwarnings(
    "ignore:Use 'content=<...>':DeprecationWarning"
)  # of the Hub's client


@pytest.fixture
def stub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[HubStub]:
    """A Hub without repositories, which the environment names."""
    stub = HubStub()
    monkeypatch.setenv("HF_TOKEN", "hf_token")
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_DISABLE_XET", True)
    with stub.run() as address:
        monkeypatch.setenv("HF_ENDPOINT", address)
        yield stub


def snapshot(tmp_path: Path) -> str:
    """The repository in the cache of the Hub's own client, a tree of links."""
    endpoint = os.environ["HF_ENDPOINT"]
    return str(
        huggingface_hub.snapshot_download(
            "owner/name", repo_type="dataset", cache_dir=tmp_path / "hub", endpoint=endpoint
        )
    )


def test_a_dataset_goes_to_the_hub_and_back(stub: HubStub, frozen: Path, tmp_path: Path) -> None:
    pushed = push_dataset(frozen, URL, tag="v1")
    assert (pushed.address, pushed.parts, pushed.sent_parts) == (f"{URL}@v1", 9, 9)
    assert stub.tags == {"v1": stub.head}
    names = [sorted(tree) for tree in stub.commits.values()]
    assert MANIFEST in names[-1] and not any(MANIFEST in tree for tree in names[:-1])
    number = len(stub.commits)
    assert push_dataset(frozen, URL, tag="v1").sent_bytes == 0
    assert len(stub.commits) == number
    pull_dataset(f"{URL}@v1", tmp_path / "out")
    assert sealed_files(tmp_path / "out") == sealed_files(frozen)


def test_the_cache_of_the_hubs_own_client_opens(
    stub: HubStub,
    frozen: Path,
    tmp_path: Path,
) -> None:
    push_dataset(frozen, URL)
    tree = snapshot(tmp_path)
    assert (Path(tree) / MANIFEST).is_symlink()
    opened = open_dataset(tree)
    assert opened.manifest.digest == open_dataset(frozen).manifest.digest
    assert verify_dataset(tree, level="deep").findings == ()


def test_a_push_that_stopped_goes_on(
    stub: HubStub,
    frozen: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(hub, "COMMIT_FILES", 2)
    whole, taken = stub._take, 0

    def stop(body: bytes, head: str) -> object:
        nonlocal taken
        taken += 1
        return (503, {}, {}) if taken == 3 else whole(body, head)

    monkeypatch.setattr(stub, "_take", stop)
    with pytest.raises(RemoteError, match="the Hub answers 503; run the same command again"):
        push_dataset(frozen, URL)
    assert push_dataset(frozen, URL).sent_parts == 5


def test_of_two_pushers_one_is_told(
    stub: HubStub,
    frozen: Path,
    last: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole, taken = stub._take, 0

    def after_another(body: bytes, head: str) -> object:
        nonlocal taken
        taken += 1
        if taken == 2:
            head = stub.commit(stub.commits[head] | {"other": b""})
        return whole(body, head)

    monkeypatch.setattr(stub, "_take", after_another)
    with pytest.raises(RemoteError, match="was changed by another push meanwhile"):
        push_dataset(frozen, URL)
    push_dataset(frozen, URL)
    with pytest.raises(RemoteError, match=r"is that of a dataset with root .*--tag NAME"):
        push_dataset(last, URL)


def test_a_tag_of_the_hub_moves_when_told_to(stub: HubStub, frozen: Path, last: Path) -> None:
    roots = [open_dataset(folder).manifest.root for folder in (frozen, last)]
    push_dataset(frozen, URL, tag="v1")
    with pytest.raises(RemoteError, match=rf"v1 names root {roots[0][:12]}; .*{roots[1][:12]}.*--move"):
        push_dataset(last, URL, tag="v1")
    assert push_dataset(last, URL, tag="v1", move=True).moved_from == roots[0]
    assert open_dataset(f"{URL}@v1").manifest.root == roots[1]
    assert push_dataset(frozen, URL, tag="v0").sent_parts == 0
    assert open_dataset(f"{URL}@v0").manifest.root == roots[0]


def test_what_the_hub_does_not_take_is_refused_before_anything_is_sent(
    stub: HubStub,
    frozen: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(hub, "ALL_FILES", 8)
    assert "advises against more than 8 files" in str(push_dataset(frozen, URL).warning)
    monkeypatch.setattr(hub, "FOLDER_FILES", 2)
    number = len(stub.log)
    with pytest.raises(RemoteError, match="a folder of the Hub has at most 2 entries"):
        push_dataset(frozen, URL)
    assert len(stub.log) == number


@pytest.mark.sweep
def test_the_library_of_the_hub_reads_both_splits(stub: HubStub, frozen: Path, tmp_path: Path) -> None:
    datasets = pytest.importorskip("datasets", reason="pip install datasets")
    push_dataset(frozen, URL)
    tree = snapshot(tmp_path)
    loaded = datasets.load_dataset(tree, "parts", cache_dir=str(tmp_path / "cache"))
    opened = open_dataset(frozen)
    assert {name: len(rows) for name, rows in loaded.items()} == {
        "train": sum(len(opened.parts.keys_of(task.index)) for task in opened.train_tasks),
        "test": sum(len(opened.parts.keys_of(task.index)) for task in opened.test_tasks),
    }


@pytest.mark.sweep
def test_the_page_of_buckets_runs_as_printed(
    server: Proxy,
    stub: HubStub,
    demo: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stub.repository = "OWNER/demo"
    monkeypatch.chdir(tmp_path)
    for name in ("demo", "built-here"):
        shutil.copytree(demo, tmp_path / "data" / name)
    namespace: dict[str, Any] = {}
    with folder_server(tmp_path / "data") as web:
        for block in blocks("docs/how-to/remote.md"):
            for address in ("http://localhost:8000", "https://example.org"):
                block = dataclasses.replace(block, text=block.text.replace(address, web))
            if block.language == "python":
                exec(compile(block.text, block.place, "exec"), namespace)
            for command in commands(block):
                short = ("--stop-at", "20") if command.words[1] == "train" else ()
                run(Command(command.words + short), block, capsys)
    assert open_dataset("data/copy").manifest.digest == open_dataset(demo).manifest.digest
