"""Datasets beyond this disk: pushed, pulled, opened part by part, tagged; with servers that spoil answers."""

# ruff: noqa: F811 # fixtures of another file
import json
import shutil
import threading
from pathlib import Path

import pytest

pytest.importorskip("obstore", reason="needs the extra `remote`")
pytest.importorskip("moto", reason="needs the extra `test`")

from tcmrl_cli.data import data
from tcmrl_cli.train import tcmrl

import tcmrl_data
from tcmrl_algo import open_run, train_run
from tcmrl_data import open_dataset, pull_dataset, push_dataset, verify_dataset
from tcmrl_data.foundation.errors import ManifestError, RemoteError, StoreError, TaskError
from tcmrl_data.remote.address import parse_address
from tcmrl_data.store.manifest import MANIFEST
from tests.commands import assert_refused, in_process
from tests.remotes import (  # noqa: F401 # fixtures
    BUCKET,
    Proxy,
    bucket,
    folder_server,
    frozen,
    last,
    own_fetched_parts,
    sealed_files,
    server,
)
from tests.small_training import SMALL, config_of


def test_what_is_pulled_is_what_was_pushed(bucket: str, frozen: Path, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    pushed = push_dataset(frozen, bucket, progress=lambda *amounts: seen.append(amounts))
    assert (pushed.parts, pushed.sent_parts) == (9, 9)
    assert seen[-1] == (111_550, 111_550)
    pulled = pull_dataset(bucket, tmp_path / "out", progress=lambda *amounts: seen.append(amounts))
    assert (pulled.parts, pulled.fetched_parts, pulled.root) == (9, 9, pushed.root)
    assert seen[-1] == (111_550, 111_550)
    assert sealed_files(tmp_path / "out") == sealed_files(frozen)
    assert verify_dataset(tmp_path / "out", level="deep").findings == ()


def test_what_is_there_is_not_sent_again(bucket: str, server: Proxy, frozen: Path, last: Path) -> None:
    push_dataset(frozen, bucket)
    server.reset()
    assert push_dataset(frozen, bucket).sent_bytes == 0
    assert len(server.log) == 1
    tagged = push_dataset(last, bucket, tag="last")
    assert (tagged.address, tagged.sent_parts) == (f"{bucket}@last", 0)
    assert tagged.sent_bytes == sum(
        (last / name).stat().st_size for name in ("tasks.jsonl", "parts.jsonl", MANIFEST)
    )
    server.reset()
    assert push_dataset(last, bucket, tag="last").sent_bytes == 0
    assert len(server.log) == 1


@pytest.mark.parametrize("tag", [None, "v1"])
def test_a_push_does_what_its_plan_says(
    bucket: str, server: Proxy, frozen: Path, last: Path, tag: str | None
) -> None:
    for folder in (last, frozen) if tag else (frozen,):  # the second finds parts of the first
        server.reset()
        plan = tcmrl_data.plan_push(folder, bucket, tag=tag, move=True)
        assert {method for method, _ in server.log} == {"GET"}
        server.reset()
        done = push_dataset(folder, bucket, tag=tag, move=True)
        assert (plan.address, plan.root, plan.parts) == (done.address, done.root, done.parts)
        assert (plan.missing_parts, plan.missing_bytes) == (done.sent_parts, done.sent_bytes)
        assert plan.requests == len(server.log)
    again = tcmrl_data.plan_push(frozen, bucket, tag=tag)
    assert (again.missing_parts, again.missing_bytes, again.requests) == (0, 0, 1)
    with pytest.raises(RemoteError, match="root"):
        tcmrl_data.plan_push(last, bucket, tag=tag)


def test_a_dataset_opens_with_three_requests_and_fetches_what_is_read(
    bucket: str, server: Proxy, frozen: Path
) -> None:
    push_dataset(frozen, bucket)
    server.reset()
    opened, here = open_dataset(bucket), open_dataset(frozen)
    assert str(opened.path) == bucket
    assert tcmrl_data.list_returns(opened) == tcmrl_data.list_returns(here)
    assert len(server.log) == 3
    key = next(iter(here.parts))
    assert opened.arrays(*key).keys() == here.arrays(*key).keys()
    assert opened.content(key) == here.content(key)
    assert len(server.log) == 4
    server.reset()
    open_dataset(bucket).fetch()
    assert len(server.log) == 1 + 8  # the manifest tells that the tables are in the cache
    with pytest.raises(TaskError, match=f"{bucket} holds no task 999"):
        opened.task(999)


def test_a_selection_is_pulled_by_its_own_parts(
    bucket: str, server: Proxy, frozen: Path, last: Path, tmp_path: Path
) -> None:
    push_dataset(frozen, bucket)
    server.reset()
    pulled = pull_dataset(bucket, tmp_path / "out", snapshots="last")
    kept = open_dataset(last).parts
    assert (pulled.root, pulled.fetched_parts) == (open_dataset(last).manifest.root, len(kept))
    assert sum(".zip" in path for _, path in server.log) == len(kept)
    assert open_dataset(tmp_path / "out").manifest.digest == open_dataset(last).manifest.digest


def test_an_address_stays_that_of_its_dataset(bucket: str, frozen: Path, last: Path) -> None:
    push_dataset(frozen, bucket)
    with pytest.raises(RemoteError, match=r"is that of a dataset with root .*--tag NAME"):
        push_dataset(last, bucket)
    assert open_dataset(bucket).manifest.root == open_dataset(frozen).manifest.root


def test_a_tag_moves_when_told_to(bucket: str, frozen: Path, last: Path) -> None:
    roots = [open_dataset(folder).manifest.root for folder in (frozen, last)]
    push_dataset(frozen, bucket, tag="v1")
    with pytest.raises(RemoteError, match=rf"v1 names root {roots[0][:12]} since .*{roots[1][:12]}.*--move"):
        push_dataset(last, bucket, tag="v1")
    assert push_dataset(last, bucket, tag="v1", move=True).moved_from == roots[0]
    assert open_dataset(f"{bucket}@v1").manifest.root == roots[1]
    assert push_dataset(frozen, bucket, tag="v1", move=True).moved_from == roots[1]
    assert open_dataset(f"{bucket}@v1").manifest.root == roots[0]
    with pytest.raises(RemoteError, match="holds no dataset; its tags are @v1"):
        open_dataset(bucket)
    with pytest.raises(RemoteError, match=r"has no tag v2; its tags are @v1"):
        open_dataset(f"{bucket}@v2")


@pytest.mark.parametrize("tag", [None, "v1"])
def test_of_two_pushers_one_wins_and_the_other_is_told(
    bucket: str, frozen: Path, last: Path, tag: str | None
) -> None:
    outcomes: dict[Path, object] = {}
    together = threading.Barrier(2)

    def push(folder: Path) -> None:
        together.wait()
        try:
            outcomes[folder] = push_dataset(folder, bucket, tag=tag).root
        except RemoteError as error:
            outcomes[folder] = error

    threads = [threading.Thread(target=push, args=(folder,)) for folder in (frozen, last)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    winners = [folder for folder, outcome in outcomes.items() if isinstance(outcome, str)]
    assert len(winners) == 1, outcomes
    opened = open_dataset(f"{bucket}@{tag}" if tag else bucket)
    assert opened.manifest.root == outcomes[winners[0]]
    opened.fetch()


def test_another_dataset_with_the_same_names_is_refused(bucket: str, frozen: Path, tmp_path: Path) -> None:
    push_dataset(frozen, bucket, tag="v1")
    other = tmp_path / "other"
    tcmrl_data.derive_dataset(frozen, other, episodes=1)
    shutil.copytree(other / "parts", tmp_path / "parts")
    with pytest.raises(RemoteError, match="holds other bytes than"):
        push_dataset(other, bucket, tag="v2")
    opened = open_dataset(f"{bucket}@v1")
    opened.fetch()


def test_what_is_damaged_on_this_disk_is_not_sent(bucket: str, frozen: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(frozen, tmp_path / "copy"))
    file = next(copy.rglob("*.zip"))
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    with pytest.raises(StoreError, match="does not have the recorded sha256"):
        push_dataset(copy, bucket)
    with pytest.raises(RemoteError, match="holds no dataset"):
        open_dataset(bucket)


def test_a_folder_behind_a_web_server_opens_and_is_pulled(frozen: Path, tmp_path: Path) -> None:
    with folder_server(frozen.parent) as address:
        opened = open_dataset(f"{address}/dataset")
        key = next(iter(opened.parts))
        assert opened.content(key) == open_dataset(frozen).content(key)
        pull_dataset(f"{address}/dataset/", tmp_path / "out")
        assert sealed_files(tmp_path / "out") == sealed_files(frozen)
        with pytest.raises(RemoteError, match="only read"):
            push_dataset(frozen, f"{address}/other")
        with pytest.raises(RemoteError, match="holds no dataset; check its spelling"):
            open_dataset(f"{address}/other")
    with pytest.raises(RemoteError, match="check address and network"):
        open_dataset(f"{address}/dataset")


def test_a_dataset_of_the_hub_is_read(frozen: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    served = tmp_path / "hub" / "datasets" / "owner" / "name" / "resolve"
    served.mkdir(parents=True)
    (served / "v1").symlink_to(frozen)
    with folder_server(tmp_path / "hub") as address:
        monkeypatch.setenv("HF_ENDPOINT", address)
        opened = open_dataset("hf://datasets/owner/name@v1")
        assert str(opened.path) == "hf://datasets/owner/name@v1"
        opened.fetch()
        pull_dataset("hf://datasets/owner/name@v1", tmp_path / "out")
        assert sealed_files(tmp_path / "out") == sealed_files(frozen)
        with pytest.raises(RemoteError, match="holds no dataset; check its spelling"):
            open_dataset("hf://datasets/owner/name")


@pytest.mark.parametrize(("protocol", "prefix"), [("s3", "AWS"), ("az", "AZURE")])
def test_who_has_no_credentials_is_told_at_once(
    protocol: str, prefix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Machines of the two clouds give credentials to their programs; this one gives none."""
    monkeypatch.setenv("AWS_METADATA_ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setenv("AZURE_MSI_ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.setenv("AZURE_STORAGE_ACCOUNT_NAME", "account")
    monkeypatch.delenv("AWS_ACCESS_KEY_ID", raising=False)
    with pytest.raises(RemoteError, match=f"check the credentials .*set {prefix}_SKIP_SIGNATURE") as raised:
        open_dataset(f"{protocol}://{BUCKET}/demo")
    assert "attempts" not in str(raised.value)


def test_without_network_the_cache_serves(frozen: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with folder_server(frozen.parent) as address:
        opened = open_dataset(f"{address}/dataset")
        first, second, *_ = opened.parts
        opened.fetch([first])
    monkeypatch.setenv("TCMRL_OFFLINE", "1")
    opened = open_dataset(f"{address}/dataset")
    assert opened.part(*first).id == opened.entry(first).id
    with pytest.raises(RemoteError, match=r"\.zip is not in the cache; unset TCMRL_OFFLINE"):
        opened.part(*second)
    with pytest.raises(RemoteError, match="is not in the cache; unset TCMRL_OFFLINE"):
        open_dataset(f"{address}/another")


def test_the_oldest_parts_make_room(frozen: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TCMRL_CACHE_LIMIT", "40k")
    with folder_server(frozen.parent) as address:
        opened = open_dataset(f"{address}/dataset")
        for key in opened.parts:
            assert opened.content(key)
    kept = [file.stat().st_size for file in (tmp_path / "cache" / "parts").rglob("*.zip")]
    assert 0 < sum(kept) <= 40_000
    assert tcmrl_data.clear_fetched() > sum(kept)
    assert sorted((tmp_path / "cache").iterdir()) == []


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("ftp://host/x", "addresses begin with s3://"),
        ("s3://", "is no address"),
        ("s3://bucket/../x", "is no address"),
        ("s3://bucket//x", "is no address"),
        ("s3://bucket/x?y", "is no address"),
        ("https://me:word@host/x", "begins no tag"),
        ("s3://bucket/x@", "a tag is 1 to 64"),
        ("s3://bucket/x@a/b", "begins no tag"),
        ("hf://owner/name", "hf://datasets/OWNER/NAME"),
        ("s3://bucket/x\x1b[2J", "is no address"),
    ],
)
def test_an_odd_address_is_refused(url: str, words: str) -> None:
    with pytest.raises(RemoteError, match=words):
        parse_address(url)


def test_the_commands(
    bucket: str, frozen: Path, last: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call = in_process(data, capsys)
    prices = ("--price-per-gb", "0.5", "--price-per-1000-requests", "2")
    code, output, _ = call("push", frozen, bucket, "--plan", *prices)
    words = (
        "9, 9 of them to send",
        "123.4 kB to send",
        "15, if none is made again",
        "0.03006, by the prices",
    )
    assert code == 0 and all(word in output for word in words)
    assert json.loads(call("push", frozen, bucket, "--plan", "--json", *prices)[1])["price"] == pytest.approx(
        0.5 * 123_431e-9 + 0.03, abs=1e-6
    )
    assert_refused(call("push", frozen, bucket, *prices), "prices are for --plan")
    assert_refused(call("push", frozen, "hf://datasets/a/b", "--plan"), "omit --plan")
    code, output, errors = call("push", frozen, bucket)
    assert (code, output) == (
        0,
        f"{bucket}: 9 parts, 9 of them sent now, with tables 123.4 kB, root 1e03bece1720\n",
    )
    assert f"Next: tcmrl-data show {bucket}" in errors
    assert call("push", last, bucket, "--tag", "last", "--quiet")[0] == 0
    code, output, _ = call("list", f"s3://{BUCKET}")
    assert code == 0
    assert bucket in output and f"{bucket}@last" in output
    code, output, errors = call("show", f"{bucket}@last")
    assert code == 0 and open_dataset(last).manifest.root in output
    assert f"tcmrl-data pull {bucket}@last FOLDER" in errors
    assert call("inspect", "returns", bucket)[0] == 0
    code, output, _ = call("pull", bucket, tmp_path / "out", "--tasks", "0", "--quiet")
    assert (code, output[: len(str(tmp_path / "out"))]) == (0, str(tmp_path / "out"))
    assert [task.index for task in open_dataset(tmp_path / "out").tasks] == [0]
    assert_refused(call("push", frozen, bucket, "--move"), "--move is for tags")
    assert_refused(
        call("push", bucket, f"{bucket}-2"), "is not on this disk", f"tcmrl-data pull {bucket} FOLDER"
    )
    for command in (["verify"], ["verify", "--repair"], ["verify", "--clean"], ["delete", "--yes"]):
        assert_refused(call(*command, bucket), "is not on this disk")


def test_what_nobody_may_use_is_not_pushed(bucket: str, frozen: Path, tmp_path: Path) -> None:
    exported = tmp_path / "exported"
    tcmrl_data.export_dataset(open_dataset(frozen), "hdf5", exported)
    tcmrl_data.import_dataset("hdf5", sorted(exported.glob("*.hdf5"))[:1], tmp_path / "imported")
    with pytest.raises(ManifestError, match=r"names no licence; .*--licence SPDX"):
        push_dataset(tmp_path / "imported", bucket)


def test_a_dataset_at_an_address_trains_to_the_same_tensors(
    tiny_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trained = []
    with folder_server(tiny_folder.parent) as address:
        for place in (tiny_folder, f"{address}/{tiny_folder.name}"):
            dataset = open_dataset(place)
            out, config = tmp_path / str(len(trained)), config_of(dataset)
            trained.append(train_run(dataset, out, config=config, profile="quick", steps=10).run)
        assert trained[1].record.dataset == f"{address}/{tiny_folder.name}"
        assert trained[1].open_dataset().manifest.root == trained[0].open_dataset().manifest.root
        call, small = in_process(tcmrl, capsys), [word for value in SMALL for word in ("--set", value)]
        typed = ("train", f"{address}/{tiny_folder.name}", "--out", tmp_path / "typed", "--quiet")
        assert call(*typed, *small, "--stop-at", 5)[0] == 0
        assert call(*typed, "--resume", "--stop-at", 10)[0] == 0
        trained.append(open_run(tmp_path / "typed"))
    assert {run.newest().step for run in trained} == {10}
    assert len({(run.newest().folder / "tensors.safetensors").read_bytes() for run in trained}) == 1
