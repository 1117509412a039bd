"""IDAQ's published protocol: which contexts it tries, and to which it returns."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from torch import Tensor, tensor

from tcmrl_algo import PROTOCOLS, Adaptation, Arena
from tcmrl_algo.evaluation.protocols.idaq import farthest
from tcmrl_data import Dataset, Trajectory
from tests.adapters import GoalReader, arena, goal_of


def latent(*values: float) -> list[np.ndarray]:
    return [np.array([value]) for value in values]


def test_the_candidate_farthest_from_all_tried_contexts_is_tried() -> None:
    candidates = latent(0.0, 1.0, 0.4)
    assert farthest(candidates, []) == 0
    assert farthest(candidates, latent(0.0)) == 1  # squared distances 0, 1, 0.16
    assert farthest(candidates, latent(0.0, 1.0)) == 2  # smallest squared distances 0, 0, 0.16
    assert farthest(latent(2.0, 2.0), latent(0.0)) == 0  # the first of equal ones
    assert farthest([np.zeros(0)] * 2, [np.zeros(0)]) == 0  # contexts of no dimension


class Scripted(Arena):
    """Episodes with given returns in the only lane, and a record of the contexts under which they ran."""

    def play(self, *returns: float, tried: int) -> tuple[list[list[object]], Adaptation]:
        """Names of the contexts of every episode, and the adaptation.

        A context is named by what it holds: a training task's index, or the numbers of own episodes.
        """
        self.settings = self.settings.model_copy(update={"episodes": len(returns), "random_episodes": tried})
        self.returns, self.contexts = returns, list[Sequence[Trajectory]]()
        self.own = [blank(value) for value in returns]
        (adaptation,) = PROTOCOLS.get("idaq_literal")().adapt(self, self.dataset.test_tasks)
        return [self.names(context) for context in self.contexts], adaptation

    def adapted(self, tasks: object, contexts: Sequence[Sequence[Trajectory]], *, episode: int) -> list:
        (context,) = contexts
        self.contexts.append(context)
        return [self.own[episode]]

    def names(self, context: Sequence[Trajectory]) -> list[object]:
        own: dict[int, object] = {id(episode): number for number, episode in enumerate(self.own, 1)}
        return [own.get(id(one), "stored") for one in context]


def blank(value: float) -> Trajectory:
    """An episode of one step with a return."""
    flags = np.zeros(1, dtype=bool)
    return Trajectory(np.zeros((2, 2)), np.zeros((1, 2)), np.array([value]), flags, flags)


@pytest.fixture
def scripted(tiny: Dataset) -> Scripted:
    plain = arena(tiny, GoalReader(), offline_trajectories=1)
    return Scripted(tiny, GoalReader(), plain.settings, capabilities=plain._capabilities, seed=0)


@pytest.mark.parametrize(
    ("returns", "contexts", "final"),
    [
        # the last episode repeats the best; a posterior that is no better is dropped for good
        ((3, 5, 4, 4, 5, 5), ["stored"] * 3 + [2, "stored", "stored"], "stored"),
        # an improvement joins the context
        ((3, 5, 4, 6, 7, 7), ["stored"] * 3 + [2, (2, 4), (2, 4)], (2, 4)),
        # after a failure, the context under which the best episode was run
        ((3, 5, 4, 6, 5, 6), ["stored"] * 3 + [2, (2, 4), 2], 2),
        # a tie is no improvement
        ((3, 5, 4, 5, 1, 1), ["stored"] * 3 + [2, "stored", "stored"], "stored"),
        # noise may improve a training task's context, whose own episodes then become the context
        ((3, 5, 4, 4, 6, 7, 6), ["stored"] * 3 + [2, "stored", (2, 5), (2, 5)], (2, 5)),
    ],
)
def test_improvements_join_the_context_and_failures_return_to_what_made_the_best(
    scripted: Scripted, returns: tuple[int, ...], contexts: list[object], final: object
) -> None:
    def names(value: object) -> list[object]:
        return list(value) if isinstance(value, tuple) else [value]

    found, adaptation = scripted.play(*returns, tried=3)
    assert found == [names(value) for value in contexts]
    (kept,) = adaptation.contexts
    assert scripted.names(kept) == names(final)
    assert adaptation.returns == list(returns)
    if final == "stored":
        assert kept is scripted.contexts[1]  # that of the best episode


def test_a_search_that_takes_all_episodes_ends_with_the_best_of_them(scripted: Scripted) -> None:
    found, adaptation = scripted.play(1, 9, 3, 9, tried=4)
    assert found == [["stored"]] * 4
    assert scripted.contexts[3] is scripted.contexts[1] is adaptation.contexts[0]
    assert scripted.play(1, tried=0)[0] == [["stored"]]


class WithLatents(GoalReader):
    """Its contexts are the goals that it reads."""

    def latents(self, trajectories: Sequence[Sequence[Trajectory]]) -> Tensor:
        return tensor(np.array([goal_of(lane[0]) for lane in trajectories]))


def test_drawn_candidates_are_training_tasks_and_repeat_exactly(tiny: Dataset) -> None:
    place = arena(tiny, GoalReader(), candidates=7)
    (task,) = tiny.test_tasks
    drawn = place.candidates(task, episode=1, lane=2)
    assert len(drawn) == 7
    assert {one.split for one in drawn} == {"train"}
    assert drawn == place.candidates(task, episode=1, lane=2)
    assert any(place.candidates(task, episode=episode, lane=3) != drawn for episode in range(2))


def test_a_method_without_latent_contexts_is_searched_by_chance_alone(tiny: Dataset) -> None:
    method = GoalReader()
    assert method.latents([]) is None
    place = arena(tiny, method, episodes=5, random_episodes=3)
    (adaptation,) = PROTOCOLS.get("idaq_literal")().adapt(place, tiny.test_tasks)
    # the first episode of its own shows the goal
    assert adaptation.returns[3] > max(adaptation.returns[:3])
    assert adaptation.returns[4] == max(adaptation.returns)


def test_the_stored_contexts_are_those_of_the_protocol_offline(tiny: Dataset) -> None:
    method = WithLatents()
    one_task = Dataset(tiny.folder, tiny.manifest)
    kept = tiny.train_tasks[0]
    one_task.tasks = (replace(kept), *tiny.test_tasks)
    place = arena(one_task, method, episodes=1, random_episodes=1, offline_trajectories=2)
    (adaptation,) = PROTOCOLS.get("idaq_literal")().adapt(place, tiny.test_tasks)
    (context,) = adaptation.contexts
    assert [id(one) for one in context] == [id(one) for one in place.stored(kept, draw=0)]
