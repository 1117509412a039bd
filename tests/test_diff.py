"""`diff`: what differs between two datasets, and the first cause."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from tcmrl_cli.data import data

import tcmrl_data
from tcmrl_data import Dataset, derive_dataset, diff_datasets, extend_dataset, open_dataset
from tcmrl_data.behavior.base import Snapshot
from tcmrl_data.dataset.diff import why_not_published
from tcmrl_data.envs.base import Task
from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.operations.assembly import PlannedPart, derivation_of, open_assembly
from tcmrl_data.parts.making import make_part
from tcmrl_data.parts.operation import WantedPart
from tcmrl_data.store.tables import PartKey
from tests.commands import assert_refused, in_process
from tests.conftest import TINY

pytestmark = pytest.mark.usefixtures("module_in_process")

KEY = PartKey(3, 100)
Change = Callable[[list[Trajectory], Snapshot], tuple[list[Trajectory], Snapshot]]


def changed(
    tiny: Dataset,
    out: Path,
    change: Change = lambda trajectories, snapshot: (trajectories, snapshot),
    *,
    seed: int = 0,
    task: Task | None = None,
) -> Dataset:
    """The tiny dataset with another part of KEY."""
    record = tiny.part(*KEY)
    trajectories, snapshot = change(tiny.trajectories(*KEY), tiny.snapshot(*KEY))
    made = make_part(
        WantedPart(
            settings=record.identity.settings,
            task=task or tiny.task(KEY.task),
            step=KEY.step,
            seed=seed,
            snapshot=snapshot,
        ),
        trajectories,
        references=record.references,
        platform=record.platform,
    )
    with open_assembly(out, derivation_of("test", {}, [tiny]), [tiny]) as assembly:
        for key in tiny.parts:
            if key != KEY:
                assembly.copy(PlannedPart(key, tiny, key))
        assembly.write(KEY, lambda: made)
        assembly.finish(runs=tiny.manifest.runs, tasks=tiny.tasks)
    return open_dataset(out)


def other_reward(trajectories: list[Trajectory], snapshot: Snapshot) -> tuple[list[Trajectory], Snapshot]:
    rewards = trajectories[2].rewards.copy()
    rewards[5] += 1
    return [*trajectories[:2], replace(trajectories[2], rewards=rewards), *trajectories[3:]], snapshot


def other_weights(trajectories: list[Trajectory], snapshot: Snapshot) -> tuple[list[Trajectory], Snapshot]:
    tensors = dict(snapshot.tensors)
    tensors["mean.bias"] = tensors["mean.bias"] + np.float32(0.5)
    return other_reward(trajectories, replace(snapshot, tensors=tensors))


def test_a_dataset_does_not_differ_from_itself(tiny: Dataset) -> None:
    for level in ("manifest", "statistics", "arrays"):
        found = diff_datasets(tiny, tiny.folder, level=level)
        assert found.is_empty
        assert (found.equal, found.different, found.left_only, found.right_only) == (15, (), (), ())
        assert (found.returns, found.observations, found.first) == (None, None, None)


def test_of_a_derived_dataset_exactly_what_was_left_out_is_named(tiny: Dataset, tmp_path: Path) -> None:
    derive_dataset(tiny, tmp_path / "less", snapshots="steps>=100", tasks=[0, 3])
    found = diff_datasets(tiny, tmp_path / "less", level="arrays")
    left_out = [key for key in tiny.parts if key.step < 100 or key.task not in (0, 3)]
    assert (found.equal, found.different, found.right_only) == (4, (), ())
    assert list(found.left_only) == left_out
    assert {change.name for change in found.tasks} == {"task 40", "task 60", "task 99"}
    assert (found.recipe, found.platforms, found.first) == ((), (), None)


def test_returns_and_observations_have_their_definitions(tiny: Dataset, tmp_path: Path) -> None:
    derive_dataset(tiny, tmp_path / "less", snapshots="steps>=150", tasks=[0, 3, 40])
    derive_dataset(tiny, tmp_path / "early", snapshots="last", tasks=[60, 99])
    left, right = (open_dataset(tmp_path / name) for name in ("less", "early"))
    found = diff_datasets(left, right)
    means = [[side.part(task.index, 150).statistics.mean for task in side.tasks] for side in (left, right)]
    interval = stats.ttest_ind(means[1], means[0], equal_var=False).confidence_interval()
    assert found.returns is not None
    assert found.returns.difference == pytest.approx(np.mean(means[1]) - np.mean(means[0]))
    assert (found.returns.low, found.returns.high) == pytest.approx((interval.low, interval.high))
    rows = [
        np.concatenate([e.observations for t in side.tasks for e in side.trajectories(t.index, 150)])
        for side in (left, right)
    ]
    shifts = (rows[1].mean(0, dtype=float) - rows[0].mean(0, dtype=float)) / rows[0].std(0, dtype=float)
    assert found.observations is not None
    assert found.observations.column == int(np.abs(shifts).argmax())
    assert found.observations.shift == pytest.approx(shifts[found.observations.column], rel=1e-5)


def test_the_first_cause_along_the_pipeline_is_named(tiny: Dataset, tmp_path: Path) -> None:
    moved = replace(tiny.task(3), parameters={"goal": [0.0, 1.0]})
    cases = {
        "seed": (changed(tiny, tmp_path / "seed", other_weights, seed=7), "0 → 7"),
        "parameters": (changed(tiny, tmp_path / "parameters", other_weights, task=moved), "goal ["),
        "policy": (changed(tiny, tmp_path / "policy", other_weights), "first mean.bias by up to 0.5"),
        "arrays": (
            changed(tiny, tmp_path / "arrays", other_reward),
            "rewards differ from episode 2, step 5 on",
        ),
    }
    for stage, (dataset, detail) in cases.items():
        found = diff_datasets(tiny, dataset, level="arrays")
        assert found.different == (KEY,)
        assert found.first is not None
        assert (found.first.key, found.first.stage) == (KEY, stage)
        assert detail in found.first.detail
    shallow = diff_datasets(tiny, cases["arrays"][0])
    assert shallow.first is not None
    assert shallow.first.detail == "rewards differ"
    assert diff_datasets(tiny, cases["arrays"][0], level="manifest").first is None


def test_settings_and_runs_are_compared(tiny: Dataset, tmp_path: Path) -> None:
    extend_dataset(tiny.folder, out=tmp_path / "more", episodes=3, tasks=[0], workers=1)
    found = diff_datasets(tiny, tmp_path / "more")
    assert found.right_only == (PartKey(0, 150, "extended"),)
    assert {"extended.kind", "extended.seed"} < {change.name for change in found.runs}
    other = tmp_path / "other"
    recipe = tcmrl_data.load_recipe(
        "point-robot",
        profile="quick",
        overrides=(
            "rollouts.episodes=2",
            "rollouts.lanes=1",
            "behavior.source=sac",
            "behavior.sac.steps=60",
            "behavior.sac.warmup=50",
            "behavior.sac.snapshots=[0,60]",
            "behavior.sac.hidden=[16,16]",
            "behavior.sac.batch_size=16",
        ),
    )
    tcmrl_data.build_dataset(recipe, other, tasks=[0, 3], workers=1)
    found = diff_datasets(tiny, other)
    assert {"rollouts.episodes", "behavior.settings.steps"} <= {change.name for change in found.recipe}
    assert found.first is not None
    assert (found.first.stage, found.first.detail) == (
        "settings",
        "behavior.settings.snapshots [0, 100, 150] → [0, 60]",
    )


def test_command_line(tiny: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    call = in_process(data, capsys)
    assert call("diff", tiny.folder, tiny.folder)[:2] == (
        0,
        f"equal: root {tiny.manifest.root[:12]}, 15 parts\n",
    )
    derive_dataset(tiny, tmp_path / "less", snapshots="last")
    code, output, errors = call("diff", tiny.folder, tmp_path / "less")
    assert (code, errors) == (1, "")
    assert "parts         5 equal, 0 differ, 10 left only, 0 right only" in output
    assert call("diff", tiny.folder, tmp_path / "less", "--json")[0] == 1
    assert_refused(call("diff", tiny.folder, tmp_path / "none"), "does not exist")


def test_a_build_says_whether_its_root_is_the_published_one(
    tiny: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tiny.manifest.root
    assert why_not_published(tiny, root) is why_not_published(tiny, root[:12]) is None
    assert why_not_published(tiny, open_dataset(tiny.folder)) is None
    assert f"has root {root[:12]}, and 000000000000 was published" in str(why_not_published(tiny, "0" * 64))
    other = changed(tiny, tmp_path / "other", other_reward)
    assert f"the first part that differs is {KEY}: " in str(why_not_published(other, tiny))
    derive_dataset(tiny, tmp_path / "less", tasks=[0, 3])
    assert "it lacks 9 parts, first task 40" in str(why_not_published(tmp_path / "less", tiny))
    call = in_process(data, capsys)
    settings = [word for value in TINY for word in ("--set", value)]
    build = ("build", "point-robot", "--profile", "quick", *settings, "--tasks", "0")
    build += ("--out", tmp_path / "built")
    code, _, errors = call(*build, "--expect-root", tiny.folder)
    assert code == 1 and "it lacks 12 parts, first task 3" in errors
    built = open_dataset(tmp_path / "built").manifest.root
    code, _, errors = call(*build, "--expect-root", built)
    assert code == 0 and "root as published" in errors
    assert_refused(call(*build, "--expect-root", tmp_path / "nothing"), "does not exist")
