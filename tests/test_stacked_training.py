"""Groups of tasks trained in lockstep: streams, resuming, units, and snapshots."""

import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3 import SAC

import tcmrl_data
from tcmrl_data import Recipe, load_recipe, open_dataset
from tcmrl_data.behavior.base import BehaviorContext, CheckpointFolder, Snapshot, checkpoint_name
from tcmrl_data.behavior.stacked import StackedSource
from tcmrl_data.behavior.stacked_training import GroupTraining
from tcmrl_data.building.ledger import Ledger
from tcmrl_data.building.plan import UnitSpec, plan_build, run_unit
from tcmrl_data.foundation.disk import CHECKPOINTS, make_folders
from tcmrl_data.foundation.errors import BuildError
from tcmrl_data.foundation.records import canonical_json, to_json
from tcmrl_data.recipe.recipe import choose_tasks, group_tasks
from tcmrl_data.store.manifest import MANIFEST
from tcmrl_data.store.tables import PartKey, part_file
from tcmrl_data.verification.cleaning import collect_garbage
from tcmrl_data.verification.repair import repair_dataset
from tests.datasets import part_ids
from tests.training_of_behavior import Interrupted, assert_resumes, context_of

pytestmark = pytest.mark.usefixtures("module_in_process")

TINY = (
    "behavior.stacked.group=4",
    "behavior.stacked.steps=130",
    "behavior.stacked.warmup=50",
    "behavior.stacked.snapshots=[0,100,130]",
    "behavior.stacked.hidden=[16,16]",
    "behavior.stacked.batch_size=16",
    "rollouts.episodes=4",
    "rollouts.lanes=2",
)
HOPPER = (*TINY, "behavior.stacked.steps=260", "behavior.stacked.snapshots=[0,200,260]")
TASKS = [1, 2, 3, 5]


def recipe_of(name: str = "point-robot-wind", overrides: Sequence[str] = TINY) -> Recipe:
    return load_recipe(name, profile="quick", overrides=overrides, behavior="stacked")


def training_of(tasks: Sequence[int], folder: Path) -> GroupTraining:
    source = recipe_of().make_source()
    assert isinstance(source, StackedSource)
    return GroupTraining(context_of(recipe_of(), tasks, folder), source.settings)


def snapshots_of(recipe: Recipe, context: BehaviorContext) -> dict[tuple[int, int], Snapshot]:
    return {
        (task.index, snapshot.step): snapshot for task, snapshot in recipe.make_source().snapshots(context)
    }


def test_what_a_task_draws_and_learns_does_not_depend_on_its_group(tmp_path: Path) -> None:
    """Replay rows of the warm-up and batch positions are equal; the policies differ by rounding at most."""
    alone, together = training_of([3], tmp_path), training_of([0, 2, 3, 7], tmp_path)
    for training in (alone, together):
        for _ in range(50):
            training.advance()
    assert torch.equal(alone._replay.rows[0, :50], together._replay.rows[2, :50])
    (own, own_noise), (shared, noise) = alone._draw(), together._draw()
    assert torch.equal(own.actions[0], shared.actions[2])
    assert torch.equal(own_noise[0], noise[2])
    for _ in range(80):
        alone.advance()
        together.advance()
    ours, theirs = alone.snapshot(0).tensors, together.snapshot(2).tensors
    for name, array in ours.items():
        np.testing.assert_allclose(array, theirs[name], rtol=0, atol=1e-5)
    assert not np.array_equal(ours["mean.weight"], together.snapshot(1).tensors["mean.weight"])


@pytest.mark.parametrize(
    ("name", "overrides", "stop_at"),
    [
        ("point-robot-wind", TINY, 30),
        ("point-robot-wind", TINY, 110),
        ("point-robot-wind", (*TINY, "behavior.stacked.buffer_size=40", "behavior.stacked.entropy=0.1"), 110),
        ("sparse-point-robot", (*TINY, "behavior.stacked.train_frequency=2"), 110),
        ("hopper-rand-params", HOPPER, 230),
    ],
)
def test_a_resumed_training_equals_an_uninterrupted_one(
    tmp_path: Path, name: str, overrides: tuple[str, ...], stop_at: int
) -> None:
    """Interrupted within an episode; in hopper the lanes are then at different steps and episodes."""
    assert_resumes(recipe_of(name, overrides), [0, 2, 3], tmp_path, stop_at=stop_at)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four tasks in two groups, built by two workers."""
    folder = tmp_path_factory.mktemp("stacked") / "dataset"
    report = tcmrl_data.build_dataset(recipe_of(), folder, tasks=TASKS, workers=2)
    assert (report.failed, report.built) == ((), len(TASKS) * 3)
    return folder


@pytest.mark.check
def test_ids_do_not_depend_on_workers(dataset: Path, tmp_path: Path) -> None:
    """They do not depend on the order in which groups are built either."""
    for half in ([5], [1, 2, 3]):
        tcmrl_data.build_dataset(recipe_of(), tmp_path / "halves", tasks=half, workers=1)
    assert part_ids(tmp_path / "halves") == part_ids(dataset)
    assert not list((dataset / CHECKPOINTS).glob("*"))
    assert open_dataset(dataset).manifest.complete


def test_a_group_trains_its_done_tasks_again_and_leaves_their_parts_alone(
    dataset: Path, tmp_path: Path
) -> None:
    tcmrl_data.build_dataset(recipe_of(), tmp_path / "grown", tasks=[1, 2], workers=1)
    before = part_ids(tmp_path / "grown")
    report = tcmrl_data.build_dataset(recipe_of(), tmp_path / "grown", tasks=[3], workers=1)
    assert (report.failed, report.built, report.present) == ((), 3, 6)
    after = part_ids(tmp_path / "grown")
    assert {key: after[key] for key in before} == before
    assert {key: part for key, part in part_ids(dataset).items() if key[0] == 3} == {
        key: part for key, part in after.items() if key[0] == 3
    }


def test_a_repaired_part_of_a_group_keeps_its_bytes(dataset: Path, tmp_path: Path) -> None:
    """The tasks of its group train along, since their absence would change its rounding."""
    folder = tmp_path / "damaged"
    shutil.copytree(dataset, folder)
    key = PartKey(2, 130)
    (folder / part_file(key)).unlink()
    report = repair_dataset(folder, workers=1)
    assert (report.repaired, report.failed, report.left) == ((key,), (), ())
    assert (folder / part_file(key)).read_bytes() == (dataset / part_file(key)).read_bytes()


def test_gc_keeps_the_checkpoint_of_a_group_until_all_its_tasks_are_done(
    dataset: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "dataset"
    shutil.copytree(dataset, folder)
    unit = choose_tasks(recipe_of(), [1, 2, 3])
    name = f"{CHECKPOINTS}/{checkpoint_name(unit)}"
    make_folders(folder / name)
    assert [(item.path, item.reason) for item in collect_garbage(folder, dry_run=True)] == [
        (name, "tasks 1 to 3 are done")
    ]
    (folder / part_file(PartKey(3, 130))).unlink()
    (folder / MANIFEST).unlink()
    Ledger(plan_build(recipe_of(), tasks=TASKS), folder).begin()
    assert collect_garbage(folder) == ()
    assert (folder / name).is_dir()


def test_groups_are_a_function_of_indices() -> None:
    tasks = choose_tasks(recipe_of(), TASKS)
    groups = group_tasks(reversed(tasks), 4)
    assert [[task.index for task in group] for group in groups] == [[1, 2, 3], [5]]
    assert [len(group) for group in group_tasks(tasks, 1)] == [1] * 4


def test_a_snapshot_acts_exactly_like_an_sb3_actor_with_its_weights(dataset: Path) -> None:
    stacked = open_dataset(dataset)
    snapshot = stacked.snapshot(2, 130)
    model = SAC(
        "MlpPolicy",
        stacked.environment.make(stacked.task(2).parameters),
        policy_kwargs={"net_arch": [16, 16]},
        device="cpu",
    )
    names = {"hidden.0": "latent_pi.0", "hidden.1": "latent_pi.2", "mean": "mu", "log_std": "log_std"}
    weights = {
        f"{names[name.rpartition('.')[0]]}.{name.rpartition('.')[2]}": torch.tensor(array)
        for name, array in snapshot.tensors.items()
    }
    model.policy.actor.load_state_dict(weights)
    observations = np.random.default_rng(0).normal(size=(50, 2)).astype(np.float32)
    expected, _ = model.predict(observations, deterministic=True)
    controller = snapshot.controller(stacked.environment, [])
    assert np.array_equal(controller.act(observations, np.zeros((50, 2), np.float32)), expected)


@pytest.mark.check
def test_agents_learn(tmp_path: Path) -> None:
    """On point-robot-wind, 1,200 steps bring every agent of a group most of the way to the goal."""
    overrides = (
        "behavior.stacked.steps=1200",
        "behavior.stacked.warmup=200",
        "behavior.stacked.snapshots=[0,1200]",
        "behavior.stacked.hidden=[32,32]",
        "behavior.stacked.batch_size=64",
        "behavior.stacked.learning_rate=3e-3",
        "behavior.stacked.tau=0.02",
    )
    recipe = recipe_of(overrides=overrides)
    snapshots = snapshots_of(recipe, context_of(recipe, [0, 1, 2, 3], tmp_path))
    environment = recipe.make_environment()
    rows = []
    for task in choose_tasks(recipe, [0, 1, 2, 3]):
        distances = []
        for step in (0, 1200):
            env = environment.make(task.parameters)
            controller = snapshots[task.index, step].controller(environment, [task.parameters])
            observation, ended = env.reset(seed=0)[0], False
            while not ended:
                action = controller.act(observation[None], np.zeros((1, 2), np.float32))[0]
                observation, _, _, ended, _ = env.step(action)
            distances.append(np.linalg.norm(observation - [1.0, 0.0]))
        rows.append(distances)
    before, after = np.transpose(rows)
    assert (after < before).all()
    assert after.mean() < 0.4 * before.mean()


@pytest.fixture
def poisoned(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second agent of every group loses a weight at step 110."""
    advance = GroupTraining.advance

    def poisoned_advance(self: GroupTraining) -> None:
        advance(self)
        if self.steps == 110:
            self.learner.actors.layers[0].weight[1, 0, 0] = torch.nan

    monkeypatch.setattr(GroupTraining, "advance", poisoned_advance)


@pytest.mark.usefixtures("poisoned")
def test_a_diverged_agent_is_named_and_the_others_are_kept(tmp_path: Path) -> None:
    recipe = recipe_of()
    found: dict[tuple[int, int], Snapshot] = {}
    context = context_of(recipe, [1, 2, 3], tmp_path)
    pairs = (
        ((task.index, snapshot.step), snapshot) for task, snapshot in recipe.make_source().snapshots(context)
    )
    with pytest.raises(BuildError, match=r"diverged: task 2 by step 130; use a smaller"):
        found.update(pairs)
    assert set(found) == {(1, 0), (2, 0), (3, 0), (1, 100), (2, 100), (3, 100), (1, 130), (3, 130)}


@pytest.mark.usefixtures("poisoned")
def test_the_others_of_a_diverged_agents_group_go_on_from_their_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    overrides = (*TINY, "behavior.stacked.steps=150", "behavior.stacked.snapshots=[0,100,120,150]")
    recipe = recipe_of(overrides=overrides)
    spec = UnitSpec(tmp_path, plan_build(recipe, tasks=[1, 2, 3]))
    monkeypatch.setattr(CheckpointFolder, "is_due", lambda self: True)
    advance, steps = GroupTraining.advance, 0

    def counted(self: GroupTraining) -> None:
        nonlocal steps
        steps += 1
        if steps == 145:
            raise Interrupted
        advance(self)

    monkeypatch.setattr(GroupTraining, "advance", counted)
    with pytest.raises(Interrupted):
        run_unit(spec, lambda message: None)
    steps = 200
    with pytest.raises(BuildError, match=r"diverged: task 2 by step 120; use a smaller"):
        run_unit(spec, lambda message: None)
    assert steps - 200 <= 20  # from the last checkpoint
    published = [
        (index, step)
        for index in (1, 2, 3)
        for step in spec.plan.source.steps
        if (tmp_path / part_file(PartKey(index, step))).is_file()
    ]
    assert published == [
        (index, step) for index in (1, 2, 3) for step in (0, 100, 120, 150) if index != 2 or step <= 100
    ]


@pytest.mark.usefixtures("poisoned")
def test_a_diverged_agent_reaches_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ill = training_of([1, 2, 3], tmp_path)
    for _ in range(130):
        ill.advance()
    monkeypatch.undo()
    healthy = training_of([1, 2, 3], tmp_path)
    for _ in range(130):
        healthy.advance()
    assert [ill.snapshot(agent).digest() == healthy.snapshot(agent).digest() for agent in range(3)] == [
        True,
        False,
        True,
    ]


def test_reduced_precision_is_recorded_with_its_error_and_left_behind_at_once(tmp_path: Path) -> None:
    recipe = recipe_of(overrides=(*TINY, "behavior.stacked.matmul_precision=medium"))
    assert recipe_of().make_source().provenance() == {}
    tcmrl_data.build_dataset(recipe, tmp_path / "dataset", tasks=[1, 2], workers=1)
    recorded = open_dataset(tmp_path / "dataset").part(1, 130).behavior
    assert recorded["matmul_precision"] == "medium"
    assert 0 < recorded["matmul_error"] < 0.05  # of a product's standard deviation; bfloat16 gives 0.013
    snapshots = recipe.make_source().snapshots(context_of(recipe, [1, 2], tmp_path))
    assert {torch.get_float32_matmul_precision() for _ in snapshots} == {"highest"}


@pytest.mark.sweep
def test_a_unit_stays_within_its_planned_memory(tmp_path: Path) -> None:
    """A separate process, with a checkpoint at every check of the clock; checkpoints dominate its memory.

    Its high-water mark is VmHWM: a new process takes over `ru_maxrss` from the one that starts it.
    """
    overrides = (
        "behavior.sac.hidden=[384,384]",
        "behavior.sac.steps=60",
        "behavior.sac.buffer_size=60",
        "behavior.sac.warmup=58",
        "behavior.sac.snapshots=[0,60]",
        "behavior.stacked.group=20",
        "rollouts.episodes=10",
    )
    recipe = load_recipe("half-cheetah-vel", profile="quick", overrides=overrides, behavior="stacked")
    plan = plan_build(recipe, tasks=range(20))
    spec = canonical_json(to_json(UnitSpec(tmp_path, plan))).decode()
    program = (
        "import json, re, sys\n"
        "from pathlib import Path\n"
        "from tcmrl_data.behavior.base import CheckpointFolder\n"
        "from tcmrl_data.building.plan import UnitSpec, run_unit\n"
        "from tcmrl_data.foundation.records import from_json\n"
        "CheckpointFolder.is_due = lambda self: True\n"
        "run_unit(from_json(UnitSpec, json.load(sys.stdin)), lambda message: None)\n"
        "print(1024 * int(re.search(r'VmHWM:\\s+(\\d+) kB', Path('/proc/self/status').read_text())[1]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], input=spec, capture_output=True, text=True, check=True
    )
    planned = plan.unit_bytes(len(plan.tasks))
    assert 0.4 * planned < int(done.stdout) < planned


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_missing_device_is_refused(tmp_path: Path) -> None:
    recipe = recipe_of(overrides=(*TINY, "behavior.stacked.device=cuda"))
    with pytest.raises(BuildError, match="finds no CUDA device; use 'cpu'"):
        snapshots_of(recipe, context_of(recipe, [1], tmp_path))
