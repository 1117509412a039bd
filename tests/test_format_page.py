"""The page on the format is enough to read and write datasets: its code knows nothing of tcmrl."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import tcmrl_data
from tcmrl_data import Dataset
from tests.page_blocks import blocks
from tests.workers import PATIENCE

PAGE = "docs/reference/format.md"

ALONE = """
import sys

class Refused:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("tcmrl_data", "tcmrl_algo", "tcmrl_cli", "zarr", "safetensors"):
            raise ImportError(name)

sys.meta_path.insert(0, Refused())
"""

PRINTED = """
def returns(part):
    _, arrays, _ = read_part("data/demo", part)
    return [float(rewards.sum(dtype="float64")) for _, _, rewards in episodes(arrays)]

print(json.dumps([[part["task"], part["step"], part["run"], returns(part)] for part in parts]))
"""

WRITTEN = """
out = Path("written")
kept, rows = tasks[:2], []
for part in parts:
    if part["task"] in [task["index"] for task in kept]:
        record, arrays, members = read_part("data/demo", part)
        made = {name: canonical(json.loads(data)) if name in ("part.json", "policy.json") else data
                for name, data in members.items()}
        for name, array in arrays.items():
            made["/".join(["arrays", name, "c", *["0"] * array.ndim])] = write_chunk(array)
        data = archive(made)
        file = out / f"parts/{part['run']}/{part['task']:05}/{part['step']:07}.zip"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)
        rows.append(part | {"sha256": sha256(data), "size": len(data)})
lines = {"tasks": [canonical(task) for task in kept],
         "parts": [canonical(list(rows[0])), *(canonical(list(row.values())) for row in rows)]}
fields = {key: value for key, value in manifest.items() if key != "digest"}
for name, table in lines.items():
    data = b"".join(table)
    (out / f"{name}.jsonl").write_bytes(data)
    fields[name] = {"lines": len(table), "bytes": len(data), "sha256": sha256(data)}
fields["totals"] = {"parts": len(rows)} | {
    name: sum(row[column] for row in rows)
    for name, column in (("episodes", "episodes"), ("steps", "steps"), ("bytes", "size"))
}
fields["root"] = root(rows)
(out / "manifest.json").write_bytes(canonical(fields | {"digest": digest(fields)}))
"""


@pytest.fixture(scope="module")
def code() -> str:
    """The page's blocks up to the ones that use other libraries."""
    found = [block.text for block in blocks(PAGE) if block.language == "python"]
    assert "import zarr" in found[-1]
    return "\n\n".join([ALONE, *found[:-1]])


def run(code: str, folder: Path) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-I", "-c", code]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=PATIENCE, check=False)


@pytest.fixture
def workplace(tiny_copy: Callable[[], Path], tmp_path: Path) -> Path:
    (tmp_path / "data").mkdir()
    tiny_copy().rename(tmp_path / "data" / "demo")
    return tmp_path


def test_the_code_of_the_page_reads_what_tcmrl_reads(code: str, workplace: Path, tiny: Dataset) -> None:
    done = run(code + PRINTED, workplace)
    assert done.returncode == 0, done.stderr
    expected = [
        [*key, [episode.undiscounted_return for episode in tiny.trajectories(*key)]] for key in tiny.parts
    ]
    assert json.loads(done.stdout) == expected


def test_a_dataset_written_by_the_page_is_verified_by_tcmrl(
    code: str, workplace: Path, tiny_folder: Path
) -> None:
    done = run(code + WRITTEN, workplace)
    assert done.returncode == 0, done.stderr
    written, derived = workplace / "written", workplace / "derived"
    assert tcmrl_data.verify_dataset(written, level="deep").findings == ()
    tcmrl_data.derive_dataset(tiny_folder, derived, tasks=[0, 3])
    assert tcmrl_data.open_dataset(written).manifest.root == tcmrl_data.open_dataset(derived).manifest.root
    for file in sorted((derived / "parts").rglob("*.zip")):
        assert (written / file.relative_to(derived)).read_bytes() == file.read_bytes()


@pytest.mark.parametrize(
    "file", ["manifest.json", "tasks.jsonl", "parts.jsonl", "parts/main/00003/0000100.zip"]
)
def test_the_code_of_the_page_finds_a_flipped_bit(code: str, workplace: Path, file: str) -> None:
    damaged = workplace / "data" / "demo" / file
    data = bytearray(damaged.read_bytes())
    data[len(data) // 2] ^= 1
    damaged.write_bytes(data)
    assert run(code, workplace).returncode == 1
