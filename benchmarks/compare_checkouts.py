"""Compares what two checkouts make: `python benchmarks/compare_checkouts.py OLD NEW`.

For changes that must change no number, such as moving code. Each checkout has its own `.venv`, as `make test`
makes it, and does all by its own commands: datasets of four kinds and what can be made of them, and for every
method a training of 50 steps and an evaluation under all protocols. Compared are part ids, roots, bytes of
archives, batches, tensors and evaluations, and the exit code is 1 if one differs. Numbers differ between
processors, so both sides are made on one machine; a side takes some five minutes of two cores. What a clean
checkout made is kept in --work under its commit, and used again.

Every setting stands in `benchmarks/references`, so that a changed default is no difference.
"""

import argparse
import concurrent.futures
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

RECIPES = Path(__file__).resolve().parent / "references"
SEED = 7

BUILDS = {
    "sac": ("point-robot-sac", "0,12"),
    "stacked": ("point-robot-stacked", "0,3,12,40,60,99"),
    "cheetah": ("half-cheetah-vel", "0,1"),
    "reach": ("ml1-reach", "0,1"),
}
"""Dataset to its recipe and tasks."""

CHANGES = {
    "extended": ["extend", "stacked", "--episodes", "3", "--noise", "0.1", "--cross", "1"],
    "relabelled": ["relabel", "stacked", "--to", "nearest:2"],
    "cut": ["derive", "stacked", "--episodes", "4", "--seed", "1", "--tasks", "0,3", "--snapshots", "last"],
    "merged": ["merge", "stacked", "sac"],
}
"""Dataset to the command that makes it of others."""

IMPORTS = {"minari": ["made/here-v0"], "idaq-npy": ["cheetah"]}
"""Format, and dataset, to the files that are read."""

METHODS = {
    name: (name, ())
    for name in (
        *("tcmrl", "focal", "focal_plus", "csro", "corro", "unicorn"),
        *("pearl", "macaw", "borel", "no_context", "task_known"),
    )
} | {
    "tcmrl, brac": ("tcmrl", ('actor_critic.brac.mode="value"', "actor_critic.clip_targets=false")),
    "tcmrl, other readings": (
        "tcmrl",
        (
            'tcmrl.sparsity="centered"',
            'tcmrl.reverse_scale="sum"',
            'tcmrl.negative_reward="max"',
            "tcmrl.weights.orthogonality=0.1",
        ),
    ),
    "focal, cloning": ("focal", ("actor_critic.cloning=1.0", 'focal.attraction="root"')),
    "corro, noise": ("corro", ('corro.negatives="reward_noise"',)),
}
"""What is trained: the method, and what differs from the recipe."""

DRAWS = """
import hashlib, sys
import tcmrl_data
from tcmrl_data import BatchRequest, Trajectories, Transitions, Windows

kinds = {
    "policy": Transitions(16, returns=True),
    "context": Trajectories((1, 3)),
    "execution": Trajectories(1, apart_from="context"),
    "windows": Windows(4, length=3),
}
selection = tcmrl_data.open_dataset(sys.argv[1]).select(split="train")
sampler = tcmrl_data.open_sampler(selection, BatchRequest(tasks=3, kinds=kinds), seed=5)
for number in (0, 1, 1000):
    batch, digest = sampler.batch(number), hashlib.sha256()
    digest.update(batch.task_indices.numpy().tobytes())
    for name in sorted(kinds):
        for field in ("observations", "actions", "rewards", "next_observations", "terminated", "mask"):
            digest.update(getattr(batch[name], field).contiguous().numpy().tobytes())
        if batch[name].returns_to_go is not None:
            digest.update(batch[name].returns_to_go.contiguous().numpy().tobytes())
    print(number, digest.hexdigest())
"""


class Checkout:
    """A checkout with its environment, and the folder that its commands work in."""

    def __init__(self, place: Path, work: Path) -> None:
        self.place, self.work = place.resolve(), work
        work.mkdir(parents=True, exist_ok=True)

    def run(self, program: str, *arguments: object) -> str:
        """What one of its programs prints; raises where it fails."""
        command = [str(self.place / ".venv/bin" / program), *map(str, arguments)]
        own = {"OMP_NUM_THREADS": "1", "MUJOCO_GL": "disabled", "TCMRL_CACHE": str(self.work / "cache")}
        done = subprocess.run(
            command, cwd=self.work, env=os.environ | own, capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise SystemExit(f"{' '.join(command)}: exit code {done.returncode}\n{done.stderr}")
        return done.stdout

    def commit(self) -> str | None:
        """The commit, None where files differ from it."""
        git = ["git", "-C", str(self.place)]
        if subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True, check=True).stdout:
            return None
        head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
        return head.stdout.strip()


def make(checkout: Checkout, inputs: Path) -> dict[str, Any]:
    """Makes everything, two commands at a time; what is compared, by what it is of."""
    made: dict[str, Any] = {}

    def build(name: str) -> None:
        recipe, tasks = BUILDS[name]
        chosen = ["--profile", "paper", "--tasks", tasks, "--seed", SEED, "--workers", 1, "--out", name]
        checkout.run("tcmrl-data", "build", RECIPES / f"{recipe}.toml", *chosen, "--quiet")

    def change(name: str) -> None:
        checkout.run("tcmrl-data", *CHANGES[name], "--out", name, "--quiet")

    def read(name: str) -> None:
        files = [inputs / name / file for file in IMPORTS[name]]
        checkout.run("tcmrl-data", "import", name, *files, "--out", name, "--quiet")

    def draw(name: str) -> None:
        made[f"batches of {name}"] = checkout.run("python", "-c", DRAWS, name).splitlines()

    def learn(label: str) -> None:
        method, changes = METHODS[label]
        run = "runs/" + "".join(letter if letter.isalnum() else "-" for letter in label)
        own = [text for value in ("run.steps=50", *changes) for text in ("--set", value)]
        common = ["--algo", method, "--profile", "paper", "--seed", SEED, "--out", run]
        checkout.run("tcmrl", "train", "stacked", *common, *own, "--quiet")
        made[f"tensors of {label}"] = dict(tensors(checkout.work / run))
        printed = checkout.run("tcmrl", "evaluate", run, "--protocol", "all", "--json", "--quiet")
        made.update({f"{document['protocol']} of {label}": document for document in json.loads(printed)})

    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        list(pool.map(build, BUILDS))
        checkout.run("tcmrl", "controls", "stacked", "--quiet")  # once, before evaluations ask for them
        tasks = [(change, CHANGES), (read, IMPORTS), (draw, ("stacked",)), (learn, METHODS)]
        list(pool.map(lambda task: task[0](task[1]), [(do, name) for do, names in tasks for name in names]))
        list(pool.map(draw, ("extended", "merged")))
        checked = ("stacked", "extended", "relabelled", "cut")
        list(pool.map(lambda name: checkout.run("tcmrl-data", "verify", name, "--replay", 2), checked))
    for name in (*BUILDS, *CHANGES, *IMPORTS):
        made[f"dataset {name}"] = dict(dataset(checkout.work / name))
    return made


def dataset(folder: Path) -> Iterator[tuple[str, Any]]:
    """The root, the tables, in which the ids stand, and the archives' digests of a dataset."""
    yield "root", json.loads((folder / "manifest.json").read_text())["root"]
    for table in ("tasks.jsonl", "parts.jsonl"):
        yield table, (folder / table).read_text().splitlines()
    for file in sorted((folder / "parts").rglob("*.zip")):
        yield str(file.relative_to(folder)), hashlib.sha256(file.read_bytes()).hexdigest()


def tensors(run: Path) -> Iterator[tuple[str, str]]:
    """The digest of every tensor of a run's newest checkpoint."""
    from safetensors import safe_open

    file = max((run / "checkpoints").glob("*/tensors.safetensors"))
    with safe_open(file, framework="numpy") as opened:  # type: ignore[no-untyped-call]
        for name in sorted(opened.keys()):
            value = opened.get_tensor(name)
            yield name, f"{value.dtype}{list(value.shape)} {hashlib.sha256(value.tobytes()).hexdigest()}"


def write_inputs(folder: Path) -> None:
    """Made-up episodes as Minari writes them and as IDAQ's code does, for both checkouts to read."""
    random = np.random.default_rng(SEED)
    for task, step in ((0, 0), (0, 500), (3, 0)):
        place = folder / "idaq-npy" / "cheetah" / f"goal_idx{task}"
        place.mkdir(parents=True, exist_ok=True)
        for number in range(2):
            rows = np.empty((5, 4), dtype=object)
            states = random.normal(size=(6, 3))
            for time_step in range(5):
                action, reward = random.uniform(-1, 1, 2), float(random.normal())
                rows[time_step] = [states[time_step], action, reward, states[time_step + 1]]
            np.save(place / f"trj_evalsample{number}_step{step}.npy", rows, allow_pickle=True)
    os.environ["MINARI_DATASETS_PATH"] = str(folder / "minari")
    import minari
    from gymnasium.spaces import Box
    from minari.data_collector import EpisodeBuffer

    episodes = []
    for length in (4, 3):
        ended = np.arange(length) == length - 1
        episodes.append(
            EpisodeBuffer(
                observations=random.normal(size=(length + 1, 2)),
                actions=random.uniform(-1, 1, (length, 1)),
                rewards=random.normal(size=length),
                terminations=ended & (length == 4),
                truncations=ended & (length == 3),
                infos={},
            )
        )
    spaces = {"observation_space": Box(-9, 9, (2,), np.float64), "action_space": Box(-1, 1, (1,), np.float64)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # author, link and environment are unknown
        minari.create_dataset_from_buffers("made/here-v0", episodes, **spaces)


def differences(old: Any, new: Any, place: str = "") -> Iterator[str]:
    """What differs between two JSON values, a line each."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in sorted(old.keys() | new.keys()):
            here = f"{place}, {key}" if place else key
            if key not in old or key not in new:
                yield f"{here}: only in the {'old' if key in old else 'new'} one"
            else:
                yield from differences(old[key], new[key], here)
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for index, (one, other) in enumerate(zip(old, new, strict=True)):
            yield from differences(one, other, f"{place}[{index}]")
    elif old != new:
        yield f"{place}: {old} there, {new} here"


def made_by(place: Path, work: Path, inputs: Path) -> dict[str, Any]:
    """What a checkout makes; taken from `work` where the same commit made it before."""
    program = hashlib.sha256(Path(__file__).read_bytes())
    for recipe in sorted(RECIPES.iterdir()):
        program.update(recipe.read_bytes())
    commit = Checkout(place, work).commit()
    kept = work / f"{commit}-{program.hexdigest()[:8]}.json"
    if commit is not None and kept.is_file():
        found: dict[str, Any] = json.loads(kept.read_text())
        return found
    began, folder = time.perf_counter(), Path(tempfile.mkdtemp(dir=work))
    made: dict[str, Any] = json.loads(json.dumps(make(Checkout(place, folder), inputs)))
    shutil.rmtree(folder)
    print(f"{place}: made in {time.perf_counter() - began:.0f} s", file=sys.stderr)
    if commit is not None:
        kept.write_text(json.dumps(made))
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Compares two checkouts; 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("old", type=Path, help="a checkout with its environment in .venv")
    parser.add_argument("new", type=Path, help="another one")
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "compare-checkouts")
    options = parser.parse_args(arguments)
    options.work.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        inputs = Path(temporary)
        write_inputs(inputs)
        old, new = (made_by(place, options.work, inputs) for place in (options.old, options.new))
    found = list(differences(old, new))
    for line in found[:100]:
        print(line)
    print(json.dumps({"compared": len(old), "differences": len(found)}))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
