"""Measures the time of a training step and its parts against the peak of matrix products. Prints JSON.

`python benchmarks/training_step.py [--threads N] [--algorithm NAME] [--precision NAME] [--repeats N]`;
random batches at the paper's network sizes, no dataset needed. Times are the minimum of the repeats; the peak
is that of float32 in both precisions. On a shared machine, read the shares by CPU time: they compare
operations per processor second of the step and of the peak.
"""

import argparse
import itertools
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from _timing import memory
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from tcmrl_algo import ContextAlgorithm
from tcmrl_algo.algorithms.core import optimizer
from tcmrl_algo.algorithms.core.method import METHODS
from tcmrl_algo.algorithms.core.problem import Problem, StagePlan
from tcmrl_algo.algorithms.core.settings import TrainingSettings
from tcmrl_algo.training.train import keep_freed_memory
from tcmrl_data import Batch, Steps

PEAK_SIZE = 1024


@dataclass(frozen=True)
class Sizes:
    """Batch sizes, with the observations and actions of the environment that names the case."""

    observation_dim: int
    action_dim: int
    context_trajectories: int
    horizon: int
    tasks: int = 16
    transitions: int = 256
    windows: int = 0


CASES = {
    "point-robot-wind": Sizes(2, 2, 10, 25),
    "half-cheetah-vel": Sizes(17, 6, 2, 200),
    "ml1, 400 transitions": Sizes(39, 4, 1, 400),
}
BASE = Sizes(17, 6, 1, 100)
GROWTH = {
    "tasks": [Sizes(17, 6, 1, 100, tasks=tasks) for tasks in (4, 8, 16, 32)],
    "steps": [Sizes(17, 6, 1, steps) for steps in (50, 100, 200, 400)],
    "windows": [Sizes(17, 6, 1, 100, windows=windows) for windows in (64, 128, 256, 512)],
}


class Stopwatch:
    """Adds up wall-clock seconds of functions by name, less the time of other named functions they call."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._inner = [0.0]

    def watch(self, owner: Any, attribute: str, name: str) -> None:
        """Times `owner.attribute` from now on."""
        function: Callable[..., Any] = getattr(owner, attribute)

        def timed(*arguments: Any, **named: Any) -> Any:
            self._inner.append(0.0)
            began = time.perf_counter()
            try:
                return function(*arguments, **named)
            finally:
                passed = time.perf_counter() - began
                self.seconds[name] = self.seconds.get(name, 0.0) + passed - self._inner.pop()
                self._inner[-1] += passed

        setattr(owner, attribute, timed)


def made_up(sizes: Sizes, algorithm: str, precision: str) -> tuple[ContextAlgorithm, Batch]:
    """An algorithm at the paper's sizes and a batch for it."""
    observation, action = sizes.observation_dim, sizes.action_dim
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    def steps(*shape: int) -> Steps:
        lead = (sizes.tasks, *shape)
        mask = torch.ones(lead, dtype=torch.bool)
        moving = draw(*lead, observation), draw(*lead, action).tanh(), draw(*lead), draw(*lead, observation)
        return Steps(*moving, torch.zeros(lead), mask)

    batch = {"tasks": sizes.tasks, "transitions": sizes.transitions, "window_length": 4}
    settings = TrainingSettings.model_validate({"batch": batch, "run": {"precision": precision}})
    method = METHODS.get(algorithm)()
    config = method.Config()
    problem = Problem(
        environment="made-up",
        observation_dim=observation,
        action_dim=action,
        horizon=sizes.horizon,
        reward_density="dense",
        observation_mean=torch.zeros(observation),
        observation_std=torch.ones(observation),
        change_mean=torch.zeros(observation),
        change_std=torch.ones(observation),
        action_mean=torch.zeros(action),
        action_std=torch.ones(action),
        reward_mean=0.0,
        reward_std=1.0,
        reward_range=(-1.0, 1.0),
        seed=0,
        stages=StagePlan(method.stages(settings, config), steps=settings.run.steps),
        training_tasks=tuple(range(sizes.tasks)),
        privileged=None,
        device=torch.device("cpu"),
    )
    made = method.create(problem, settings, config)
    assert isinstance(made, ContextAlgorithm)
    kinds = {
        "policy": steps(sizes.transitions),
        "context": steps(sizes.context_trajectories, sizes.horizon),
        "execution": steps(1, sizes.horizon),
    }
    if sizes.windows:
        kinds["windows"] = steps(sizes.windows, 4)
    return made, Batch(torch.arange(sizes.tasks), kinds)


def matmul_peak() -> tuple[float, float]:
    """Operations of a square float32 product, per wall-clock second and per second of processor time."""
    left, right = torch.randn(2, PEAK_SIZE, PEAK_SIZE)
    out = torch.empty(PEAK_SIZE, PEAK_SIZE)
    wall = processor = float("inf")
    for _ in range(8):
        began, busy = time.perf_counter(), time.process_time()
        torch.mm(left, right, out=out)
        wall = min(wall, time.perf_counter() - began)
        processor = min(processor, time.process_time() - busy)
    return 2 * PEAK_SIZE**3 / wall, 2 * PEAK_SIZE**3 / processor


def products(widths: list[int], rows: int, *, weights: bool = True, inputs: int = 0) -> int:
    """Operations of a perceptron: forward pass, weight gradients, and gradients of `inputs` of its inputs."""
    layers = [a * b for a, b in itertools.pairwise(widths)]
    gradients = sum(layers) if weights else 0
    if weights or inputs:
        gradients += sum(layers[1:]) + inputs * widths[1]
    return 2 * rows * (sum(layers) + gradients)


def needed_work(made: ContextAlgorithm, sizes: Sizes) -> int:
    """Operations of the perceptrons that the method needs, without gradients that are never read."""

    def widths(network: nn.Module) -> list[int]:
        layers = [module for module in network.modules() if isinstance(module, nn.Linear)]
        return [layers[0].in_features, *(layer.out_features for layer in layers)]

    actor_critic, learner = made.actor_critic, made.learner
    rows, action = sizes.tasks * sizes.transitions, sizes.action_dim
    critic = widths(actor_critic.critics.members[0])
    total = 2 * products(critic, rows) + 2 * products(critic, rows, weights=False, inputs=action)
    total += products(widths(actor_critic.value), rows) + products(widths(actor_critic.policy), rows)
    total += products(widths(actor_critic.target_value), rows, weights=False)
    context = sizes.tasks * sizes.context_trajectories * sizes.horizon
    execution = sizes.tasks * sizes.horizon
    windows = sizes.tasks * sizes.windows * 4
    for name, network in learner.named_children():
        width = widths(network)
        if name == "encoder":
            total += products(width, context + execution + windows)
        elif name == "extractor":  # over the whole context of a task, and over every single trajectory
            total += products(width, 2 * context + execution, inputs=width[0])
        elif name == "estimator":  # with the context, and with the reverse context and fixed weights
            total += products(width, execution, inputs=learner.latent)
            total += products(width, execution, weights=False, inputs=learner.latent)
    return total


def measure(sizes: Sizes, *, algorithm: str, precision: str, repeats: int) -> dict[str, Any]:
    """Seconds and operations of a step, in total and by part."""
    made, batch = made_up(sizes, algorithm, precision)
    made.update(batch, 1)
    with FlopCounterMode(display=False) as counter:
        made.update(batch, 2)
    peaks, walls, processors = [], [], []
    for step in range(3, 3 + repeats):
        peaks.append(matmul_peak())
        began, processor = time.perf_counter(), time.process_time()
        made.update(batch, step)
        walls.append(time.perf_counter() - began)
        processors.append(time.process_time() - processor)
    needed = needed_work(made, sizes)
    peak, peak_by_processor = (max(values) for values in zip(*peaks, strict=True))
    return {
        "sizes": vars(sizes),
        "milliseconds": 1e3 * min(walls),
        "cpu_milliseconds": 1e3 * min(processors),
        "gigaflop_needed": needed / 1e9,
        "gigaflop_done": counter.get_total_flops() / 1e9,
        "peak_gigaflop_per_second": peak / 1e9,
        "share_of_peak": needed / min(walls) / peak,
        "share_of_peak_by_cpu_time": needed / min(processors) / peak_by_processor,
    }


def components(sizes: Sizes, *, algorithm: str, precision: str, repeats: int) -> dict[str, float]:
    """Milliseconds per step of every part, without the time of the parts inside it.

    Call this last: the functions stay wrapped afterwards.
    """
    made, batch = made_up(sizes, algorithm, precision)
    made.update(batch, 1)
    least: dict[str, float] = {}
    watch = Stopwatch()
    if hasattr(made.learner, "encoder"):
        watch.watch(made.learner.encoder, "forward", "encoder forward")
    watch.watch(made.learner, "losses", "context losses forward")
    watch.watch(made.actor_critic, "losses", "actor-critic forward")
    watch.watch(Tensor, "backward", "backward")
    watch.watch(optimizer, "_descend", "optimizer")
    watch.watch(made.actor_critic, "after_step", "target network")
    watch.watch(made, "update", "rest")
    for step in range(2, 2 + repeats):
        watch.seconds.clear()
        made.update(batch, step)
        for name, seconds in watch.seconds.items():
            least[name] = min(least.get(name, float("inf")), 1e3 * seconds)
    return least


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--algorithm", default="tcmrl")
    parser.add_argument("--precision", choices=["float32", "bfloat16"], default="float32")
    parser.add_argument("--repeats", type=int, default=10)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    keep_freed_memory()
    how = {"algorithm": options.algorithm, "precision": options.precision, "repeats": options.repeats}
    document = {
        "algorithm": options.algorithm,
        "precision": options.precision,
        "threads": options.threads,
        "torch": torch.__version__,
        "load_average": os.getloadavg()[0],
        "steps": {name: measure(sizes, **how) for name, sizes in CASES.items()},
        "growth": {
            name: [{**vars(case), "gigaflop": measure(case, **how)["gigaflop_done"]} for case in cases]
            for name, cases in GROWTH.items()
        },
        "components_milliseconds": {name: components(sizes, **how) for name, sizes in CASES.items()},
        "peak_memory_megabytes": memory("VmHWM") / 2**20,
    }
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
