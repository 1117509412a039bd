"""The contract of every method: determinism, stages, tensors, adaptation as its capabilities state."""

import inspect
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tcmrl_cli.train import tcmrl
from torch import Tensor

from tcmrl_algo import open_run
from tcmrl_algo.algorithms.core.context import KINDS, ContextAlgorithm, ContextLearner
from tcmrl_algo.algorithms.core.method import METHODS, Algorithm, Method
from tcmrl_algo.algorithms.core.problem import Problem, StagePlan
from tcmrl_algo.algorithms.core.settings import TrainingSettings
from tcmrl_algo.training.config import stage_plan
from tcmrl_data import Batch, Controller, LaneTransition, Steps, Trajectory, UniformController
from tests.commands import in_process
from tests.made_up import (
    ACTION_DIM,
    OBSERVATION_DIM,
    TASKS,
    batch,
    batch_for,
    problem,
    scramble,
    settings,
    trajectory,
)

STEPS = 6
"""Of the whole training here: more than the first stages of `double_stages` take."""
every = pytest.mark.parametrize("name", METHODS.names())


class Made:
    """A method, the plan of its stages, and batches for every step."""

    def __init__(self, name: str, *, seed: int = 0, **actor_critic: Any) -> None:
        self.method: Method[Any] = METHODS.get(name)()
        self.settings: TrainingSettings = settings(steps=STEPS, **actor_critic)
        self.config = self.method.Config()
        self.stages = StagePlan(self.method.stages(self.settings, self.config), steps=STEPS)
        self.problem: Problem = problem(
            seed=seed, stages=self.stages, privileged=self.method.capabilities.privileged
        )
        self.algorithm: Algorithm = self.method.create(self.problem, self.settings, self.config)

    def batch(self, step: int) -> Batch:
        """The batch of a step: the kinds that its stage requests, and no other."""
        stage = self.stages.at(step).stage
        (request,) = [found.request for found in self.stages if found.name == stage]
        return batch_for(request, seed=step)

    def train(self, first: int, last: int) -> None:
        for step in range(first, last + 1):
            self.algorithm.update(self.batch(step), step)

    def adapt(self, lanes: list[list[Trajectory]], tasks: tuple[int, ...] = (0, 1)) -> Controller:
        """The controller adapted to the trajectories, or to the tasks' parameters for a privileged method."""
        known = self.problem.privileged
        return self.algorithm.adapt(lanes, privileged=None if known is None else known[list(tasks)])

    def snapshot(self) -> dict[str, Tensor]:
        return {name: value.clone() for name, value in self.algorithm.tensors().items()}


def act(controller: Controller, lanes: int = 2) -> np.ndarray:
    states = np.linspace(-1.0, 1.0, OBSERVATION_DIM, dtype=np.float32)
    noise = np.zeros((lanes, ACTION_DIM), dtype=np.float32)
    return controller.act(np.tile(states, (lanes, 1)), noise)


LANES = [[trajectory(6, 0)], [trajectory(4, 1), trajectory(2, 2)]]


def assert_equal(first: dict[str, Tensor], second: dict[str, Tensor]) -> None:
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert torch.equal(value, second[name]), name


@every
def test_a_method_is_complete_and_its_settings_are_documented(name: str) -> None:
    method = METHODS.get(name)
    assert method.name == name
    assert not inspect.signature(method).parameters
    assert method.Config.model_config.get("frozen") and method.Config.model_config.get("extra") == "forbid"
    for field in method.Config.model_fields:
        documented = f"{field}:" in (method.Config.__doc__ or "")
        assert documented, f"no {field!r} under `Attributes:` in the docstring of {method.Config.__name__}"


@every
def test_updates_are_a_function_of_seed_and_step(name: str) -> None:
    results = []
    for global_seed in (0, 1):
        torch.manual_seed(global_seed)
        made = Made(name)
        for step in range(1, STEPS + 1):
            metrics = made.algorithm.update(made.batch(step), step)
            assert all(value.shape == () and torch.isfinite(value) for value in metrics.values())
        results.append(made.algorithm.tensors())
    assert_equal(*results)
    other = Made(name, seed=1).algorithm.tensors()
    assert any(not torch.equal(value, results[0][name]) for name, value in other.items())


@every
@pytest.mark.parametrize(
    "actor_critic", [{}, {"brac": {"mode": "value"}}, {"kind": "iql"}, {"kind": "bc"}], ids=str
)
def test_a_learner_goes_on_from_its_tensors_at_every_step(name: str, actor_critic: dict[str, Any]) -> None:
    """In the middle of a stage and at its end, the next step equals that of an uninterrupted training."""
    straight = Made(name, **actor_critic)
    if isinstance(straight.algorithm, ContextAlgorithm):
        assert type(straight.algorithm.actor_critic) is KINDS[actor_critic.get("kind", "sac")]
    for step in range(1, STEPS + 1):
        resumed = Made(name, **actor_critic)
        resumed.algorithm.load_tensors(straight.snapshot())
        for made in (straight, resumed):
            made.train(step, step)
        assert_equal(straight.algorithm.tensors(), resumed.algorithm.tensors())


@every
def test_padding_changes_no_update(name: str) -> None:
    plain, padded = Made(name), Made(name)
    for step in range(1, STEPS + 1):
        plain.algorithm.update(plain.batch(step), step)
        other = padded.batch(step)
        steps = {kind: scramble(other[kind]) for kind in other.names()}
        padded.algorithm.update(replace(other, steps=steps), step)
    expected, found = plain.algorithm.tensors(), padded.algorithm.tensors()
    for key, value in expected.items():
        torch.testing.assert_close(found[key], value, msg=key, rtol=1e-3, atol=1e-4)


@every
def test_adaptation_changes_no_tensor_and_follows_every_lane_alone(name: str) -> None:
    made = Made(name)
    made.train(1, STEPS)
    before = made.snapshot()
    actions = act(made.adapt(LANES))
    assert actions.shape == (2, ACTION_DIM)
    assert np.isfinite(actions).all() and np.abs(actions).max() <= 1
    alone = [act(made.adapt([lane], tasks=(index,)), lanes=1)[0] for index, lane in enumerate(LANES)]
    np.testing.assert_allclose(np.array(alone), actions, rtol=1e-4, atol=1e-6)  # lanes are independent
    assert_equal(before, made.algorithm.tensors())


@every
def test_contexts_follow_the_order_of_tasks(name: str) -> None:
    made = Made(name)
    learner = context_learner(made)
    made.train(1, STEPS)
    steps, order = batch()["context"], [2, 0, 1]
    with torch.no_grad():
        plain = learner.context(steps)
        found = learner.context(steps.map(lambda values: values[order]))
    torch.testing.assert_close(found, plain[order])


def context_learner(made: Made) -> ContextLearner:
    """What makes the method's contexts; skips a test of contexts where nothing does."""
    if not isinstance(made.algorithm, ContextAlgorithm):
        pytest.skip(f"{made.method.name} adapts without contexts")
    return made.algorithm.learner


@every
def test_contexts_of_training_follow_the_order_of_tasks_unless_they_are_noisy(name: str) -> None:
    made = Made(name)
    learner = context_learner(made)
    made.train(1, STEPS - 1)
    plain, order = made.batch(STEPS), [2, 0, 1]
    kinds = {kind: plain[kind].map(lambda values: values[order]) for kind in plain.names()}
    turned = Batch(plain.task_indices[order], kinds)
    contexts = [
        learner.losses(values, STEPS, torch.Generator().manual_seed(0)).context for values in (plain, turned)
    ]
    assert contexts[0] is not None and contexts[1] is not None
    if made.method.capabilities.noisy_contexts:
        assert not torch.allclose(contexts[1], contexts[0][order], atol=1e-3)
    else:
        torch.testing.assert_close(contexts[1], contexts[0][order])


@every
def test_trajectories_matter_unless_the_method_is_blind(name: str) -> None:
    made = Made(name)
    made.train(1, STEPS)
    actions = act(made.adapt(LANES, tasks=(0, 0)))
    assert np.allclose(actions[0], actions[1], atol=1e-7) is made.method.capabilities.blind


@every
def test_task_parameters_matter_where_a_method_may_see_them(name: str) -> None:
    made = Made(name)
    same = [LANES[0], LANES[0]]
    actions = act(made.adapt(same, tasks=(0, 1)))
    assert np.allclose(actions[0], actions[1], atol=1e-7) is not made.method.capabilities.privileged


@every
def test_steps_change_how_a_controller_acts_only_where_it_is_stateful(name: str) -> None:
    made = Made(name)
    controller = made.adapt(LANES)
    before = act(controller)
    np.testing.assert_array_equal(act(controller), before)  # no exploration
    controller.observe(observed(active=(True, False)))
    after = act(controller)
    np.testing.assert_array_equal(after[1], before[1])  # a lane that has ended stands still
    assert np.array_equal(after[0], before[0]) is not made.method.capabilities.stateful


def observed(*, active: tuple[bool, ...]) -> LaneTransition:
    """One step of several lanes."""
    random, lanes = np.random.default_rng(0), len(active)
    states = random.normal(size=(2, lanes, OBSERVATION_DIM)).astype(np.float32)
    ended = np.zeros(lanes, dtype=bool)
    actions = random.uniform(-1, 1, (lanes, ACTION_DIM)).astype(np.float32)
    rewards = random.normal(size=lanes).astype(np.float32)
    return LaneTransition(states[0], actions, rewards, states[1], ended, ended, np.array(active))


@every
def test_no_trajectory_is_a_context_where_the_method_needs_none(name: str) -> None:
    made = Made(name)
    if made.method.capabilities.needs_trajectories:
        pytest.skip(f"{name} needs a trajectory")
    made.train(1, STEPS)
    actions = act(made.adapt([[], LANES[0]]))
    assert np.isfinite(actions).all()
    np.testing.assert_allclose(actions[0], act(made.adapt([[]], tasks=(0,)), lanes=1)[0], rtol=1e-5)


@every
def test_exploration_is_uniform_unless_the_method_says_otherwise(name: str) -> None:
    made = Made(name)
    last = [[trajectory(4, lane)] * (made.settings.run.random_episodes - 1) for lane in range(2)]
    collectors = [made.algorithm.explore(lanes) for lanes in ([[], []], last)]
    own = not all(isinstance(collector, UniformController) for collector in collectors)
    capabilities = made.method.capabilities
    assert own is (capabilities.explores and capabilities.explores_by_default)
    assert {act(collector).shape for collector in collectors} == {(2, ACTION_DIM)}


@every
def test_rewards_that_are_all_zero_train_and_adapt(name: str) -> None:
    made = Made(name)
    for step in range(1, STEPS + 1):
        drawn = made.batch(step)
        steps = {kind: without_rewards(drawn[kind]) for kind in drawn.names()}
        metrics = made.algorithm.update(replace(drawn, steps=steps), step)
        assert all(torch.isfinite(value) for value in metrics.values())
    lanes = [[replace(found, rewards=np.zeros_like(found.rewards)) for found in lane] for lane in LANES]
    assert np.isfinite(act(made.adapt(lanes))).all()


def without_rewards(values: Steps) -> Steps:
    returns = None if values.returns_to_go is None else torch.zeros_like(values.returns_to_go)
    return replace(values, rewards=torch.zeros_like(values.rewards), returns_to_go=returns)


def test_tasks_of_a_batch_are_found_among_the_training_tasks() -> None:
    assert TASKS == 3
    assert problem().position(torch.tensor([9, 2])).tolist() == [2, 0]


@pytest.mark.parametrize("name", [name for name in METHODS.names() if METHODS.provider(name) != "tcmrl"])
def test_a_method_of_another_package_trains_resumes_and_evaluates_by_the_command_line(
    name: str, tiny_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call = in_process(tcmrl, capsys)
    settings = ["batch.transitions=8", "actor_critic.hidden=[8]", "run.log_every=1"]
    common = ["train", tiny_folder, "--algo", name, "--json", "--set", "run.steps=8"]
    common += [text for value in settings for text in ("--set", value)]
    digests = []
    for folder, stops in (("straight", (8,)), ("stopped", (3, 8))):
        for stop in stops:
            more = ["--stop-at", stop, "--out", tmp_path / folder]
            resumed = ["train", tiny_folder, "--resume", "--json", *more]
            code, output, errors = call(*(resumed if stop != stops[0] else [*common, *more]))
            assert code == 0, errors
        digests.append(json.loads(output)["digest"])
    assert digests[0] == digests[1]  # stopped in the middle of a stage
    lines = (tmp_path / "straight/metrics.jsonl").read_text().splitlines()
    stages = {json.loads(line)["stage"] for line in lines}
    planned = stage_plan(open_run(tmp_path / "straight").record.config)
    assert stages == {part.name for part in planned}
    code, output, errors = call(
        "evaluate", tmp_path / "straight", "--json", "--protocol", "paper", "--episodes", 3
    )
    assert code == 0, errors
    assert json.loads(output)["algorithm"] == name
