"""Task parameters as numbers, for privileged methods."""

import pytest
import torch

from tcmrl_algo.algorithms.core.problem import TaskParameters
from tcmrl_data import Task, TrainingError


def task(index: int, **parameters: object) -> Task:
    return Task(index, "train", parameters)


def test_parameters_are_standardised_by_the_training_tasks() -> None:
    training = [task(0, goal=[1.0, 5.0], angle=3), task(1, goal=[3.0, 5.0], angle=5)]
    scaled = TaskParameters(training)
    torch.testing.assert_close(scaled(training), torch.tensor([[-1.0, -1.0, 0.0], [1.0, 1.0, 0.0]]))
    torch.testing.assert_close(scaled([task(7, angle=4, goal=[4.0, 6.0])]), torch.tensor([[0.0, 2.0, 1.0]]))


def test_a_parameter_that_is_no_number_is_named() -> None:
    scaled = TaskParameters([task(3, side="right", speed=1.0)])
    with pytest.raises(TrainingError, match=r"task 4 has the parameter 'left'"):
        scaled([task(4, side="left", speed=1.0)])
    with pytest.raises(TrainingError, match=r"task 4 has the parameter 'left'"):
        TaskParameters([task(3, side="right"), task(4, side="left")])


def test_a_text_that_all_tasks_share_is_left_out() -> None:
    scaled = TaskParameters([task(0, simulator="arm", speed=1.0), task(1, simulator="arm", speed=3.0)])
    torch.testing.assert_close(scaled([task(2, simulator="arm", speed=4.0)]), torch.tensor([[2.0]]))
