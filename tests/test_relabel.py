"""`relabel`: rewards of other tasks by simulating stored episodes again."""

import copy
import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tcmrl_cli.data import data

import tcmrl_data
from tcmrl_data import (
    BatchRequest,
    Dataset,
    Trajectory,
    Transitions,
    derive_dataset,
    extend_dataset,
    merge_datasets,
    open_dataset,
    open_sampler,
    relabel_dataset,
    verify_dataset,
)
from tcmrl_data.envs.rollout import PlaybackController
from tcmrl_data.foundation.errors import BuildError, SelectionError, SimulationError
from tcmrl_data.foundation.seeding import Purpose, keyed_seed
from tcmrl_data.operations.assembly import PlannedPart, derivation_of, open_assembly
from tcmrl_data.parts.making import make_part
from tcmrl_data.parts.operation import WantedPart
from tcmrl_data.store.tables import PartKey
from tests.commands import assert_refused, in_process
from tests.conftest import SIMULATED

pytestmark = pytest.mark.usefixtures("module_in_process")

REQUEST = BatchRequest(tasks=2, kinds={"policy": Transitions(4)})
Build = Callable[[str], Path]


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Build:
    """Builds two tasks of an environment."""

    def make(environment: str) -> Path:
        folder = tmp_path_factory.mktemp("built") / "data"
        recipe = tcmrl_data.load_recipe(
            environment, profile="quick", overrides=[*SIMULATED, "rollouts.episodes=2"]
        )
        tasks = [
            task.index for task in tcmrl_data.draw_tasks(recipe.make_environment()) if task.split == "train"
        ]
        assert tcmrl_data.build_dataset(recipe, folder, tasks=tasks[:2], workers=2).failed == ()
        return folder

    return make


def test_only_rewards_change_and_are_those_of_the_other_task(build: Build, tmp_path: Path) -> None:
    source = open_dataset(build("half-cheetah-vel"))
    first, second = (task.index for task in source.tasks)
    report = relabel_dataset(source, tmp_path / "out", to="all", workers=2)
    assert (report.pairs, report.parts, report.runs) == (2, 4, ("relabelled",))
    made = open_dataset(tmp_path / "out")
    for key in (PartKey(second, step, "relabelled") for step in (0, 60)):
        old, new = source.trajectories(first, key.step), made.trajectories(*key)
        environment = source.environment.make(source.task(second).parameters)
        for number, (left, right) in enumerate(zip(old, new, strict=True)):
            assert left.observations.tobytes() == right.observations.tobytes()
            assert left.actions.tobytes() == right.actions.tobytes()
            environment.reset(seed=keyed_seed(0, source.name, first, Purpose.ROLLOUT_RESET, key.step, number))
            rewards = np.array([environment.step(action)[1] for action in left.actions], dtype=np.float32)
            assert right.rewards.tobytes() == rewards.tobytes()
            assert left.rewards.tobytes() != rewards.tobytes()
        identity = made.part(*key).identity
        assert identity.derived == {
            "operation": "relabel",
            "from": [source.entry(PartKey(first, key.step)).id],
            "settings": {"task": first, "first_episode": 0},
        }
    assert verify_dataset(made.folder, level="deep", replay=100).findings == ()


@pytest.mark.parametrize("environment", ["point-robot-wind", "hopper-rand-params"])
def test_tasks_with_other_dynamics_are_refused_and_the_step_is_named(
    environment: str, build: Build, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = build(environment)
    with pytest.raises(SimulationError, match="observations differ at step 1 of episode 0"):
        relabel_dataset(folder, tmp_path / "out", to="all", workers=1)
    result = in_process(data, capsys)("relabel", folder, "--to", "all", "--out", tmp_path / "out", "--quiet")
    assert_refused(result, "cannot be relabelled to task", "observations differ at step 1")
    assert not (tmp_path / "out").exists()


def test_pairs_that_reach_a_task_lie_in_different_runs(tiny: Dataset, tmp_path: Path) -> None:
    first, *others = (task.index for task in tiny.train_tasks)
    report = relabel_dataset(tiny, tmp_path / "out", to=[first], snapshots="last", workers=1)
    made = open_dataset(tmp_path / "out")
    assert report.runs == ("relabelled", "relabelled-2", "relabelled-3")
    assert [run.source_of(first) for run in made.manifest.runs] == others
    assert [task.index for task in made.tasks] == [first]
    near = relabel_dataset(tiny, tmp_path / "near", to="nearest:1", snapshots="last", dry_run=True)
    assert (near.pairs, near.root) == (4, None)


def test_what_comes_from_a_test_task_is_not_trained_on(tiny: Dataset, tmp_path: Path) -> None:
    (test,) = (task.index for task in tiny.test_tasks)
    first, second, third, _ = (task.index for task in tiny.train_tasks)
    for wrong in ({"to": [test]}, {"to": "all", "tasks": [first, test]}):
        with pytest.raises(SelectionError, match=f"task {test} is a test task"):
            relabel_dataset(tiny, tmp_path / "out", **wrong)
    relabel_dataset(
        tiny, tmp_path / "out", to=[first, second], tasks=[test], snapshots="last", allow_test=True, workers=1
    )
    derive_dataset(tmp_path / "out", tmp_path / "less", episodes=3)
    merge_datasets([tiny.folder, tmp_path / "out"], tmp_path / "both")
    for folder in (tmp_path / "out", tmp_path / "less", tmp_path / "both"):
        leaky = open_dataset(folder)
        assert leaky.manifest.derivation is not None
        with pytest.raises(SelectionError, match=f"was made from task {test}, which is no training task"):
            open_sampler(leaky.select(split="train"), REQUEST, seed=0)
        open_sampler(leaky.select(split="train", allow_test=True), REQUEST, seed=0)
    assert open_dataset(tmp_path / "out").manifest.derivation.settings["allow_test"]  # type: ignore[union-attr]
    relabel_dataset(tiny, tmp_path / "train", to=[first, second], tasks=[third], snapshots="last", workers=1)
    open_sampler(open_dataset(tmp_path / "train").select(split="train"), REQUEST, seed=0)


def test_bad_input_writes_nothing(tiny: Dataset, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first, second, *_ = (task.index for task in tiny.train_tasks)
    for wrong, error, text in (
        ({"to": "nearest"}, SelectionError, "expected task indices, all, or nearest:K"),
        ({"to": "nearest:9"}, SelectionError, "choose fewer neighbours"),
        ({"to": [first], "tasks": [first]}, SelectionError, "no task is left"),
        ({"to": "all", "of": "other"}, SelectionError, "it has main"),
        ({"to": [1]}, tcmrl_data.TcmrlError, "no task 1"),
    ):
        with pytest.raises(error, match=text):
            relabel_dataset(tiny, out, **wrong)
    relabel_dataset(tiny, tmp_path / "made", to=[first], tasks=[second], snapshots="last", workers=1)
    with pytest.raises(BuildError, match="run relabelled is relabelled"):
        relabel_dataset(tmp_path / "made", out, to=[first], of="relabelled")
    assert not out.exists()


def forged(dataset: Dataset, out: Path, change: Callable[[Trajectory], Trajectory]) -> Path:
    """A copy whose derived parts hold changed episodes under ids and digests that agree with them."""
    with open_assembly(out, derivation_of("test", {}, [dataset]), [dataset]) as assembly:
        for key in dataset.parts:
            record = dataset.part(*key)
            identity = record.identity
            if identity.derived is None:
                assembly.copy(PlannedPart(key, dataset, key))
            else:
                made = make_part(
                    WantedPart(
                        settings=identity.settings,
                        task=dataset.task(key.task),
                        step=key.step,
                        seed=identity.seed,
                        snapshot=dataset.snapshot(*key),
                        derived=identity.derived,
                    ),
                    [change(episode) for episode in dataset.trajectories(*key)],
                    references=record.references,
                    platform=record.platform,
                )
                assembly.write(key, functools.partial(copy.copy, made))
        assembly.finish(runs=dataset.manifest.runs, tasks=dataset.tasks)
    return out


def test_a_deep_verification_finds_forged_parts(tiny: Dataset, tmp_path: Path) -> None:
    first, second, *_ = (task.index for task in tiny.train_tasks)
    relabel_dataset(tiny, tmp_path / "made", to=[first], tasks=[second], snapshots="last", workers=1)
    extend_dataset(tiny.folder, out=tmp_path / "more", episodes=3, tasks=[first], workers=1)

    def better(episode: Trajectory) -> Trajectory:
        return replace(episode, rewards=episode.rewards + np.float32(0.5))

    for name, run in (("made", "relabelled"), ("more", "extended")):
        true = open_dataset(tmp_path / name)
        assert verify_dataset(true.folder, level="deep").findings == ()
        folder = forged(true, tmp_path / f"forged-{name}", better)
        assert verify_dataset(folder).findings == ()
        (finding,) = verify_dataset(folder, level="deep").findings
        assert (finding.run, finding.task) == (run, first)
        assert "made again: rewards differs in" in finding.problem


def test_a_part_that_names_another_source_is_found(tiny: Dataset, tmp_path: Path) -> None:
    first, second, *_ = (task.index for task in tiny.train_tasks)
    extend_dataset(tiny.folder, out=tmp_path / "more", episodes=3, tasks=[first], workers=1)
    more = open_dataset(tmp_path / "more")
    record = more.part(first, 150, "extended")
    assert record.identity.derived is not None
    record.identity.derived["from"] = [tiny.entry(PartKey(second, 150)).id]
    folder = forged(more, tmp_path / "forged", lambda episode: episode)
    assert verify_dataset(folder).findings == ()
    (finding,) = verify_dataset(folder, level="deep").findings
    assert "which it names as its source" in finding.problem


def test_playback_goes_on_with_zeros() -> None:
    controller = PlaybackController([np.ones((1, 2), np.float32), np.full((2, 2), 0.5, np.float32)])
    nothing = np.zeros((2, 2), np.float32)
    assert controller.act(nothing, nothing).tolist() == [[1, 1], [0.5, 0.5]]
    assert controller.act(nothing, nothing).tolist() == [[0, 0], [0.5, 0.5]]
