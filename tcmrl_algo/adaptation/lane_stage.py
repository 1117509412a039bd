"""Where episodes of several tasks are run: lanes that are stepped together and kept for the next episodes."""

from collections.abc import Callable, Sequence
from typing import final

from tcmrl_data import (
    Controller,
    Environment,
    Lanes,
    Purpose,
    Task,
    Trajectory,
    keyed_generator,
    keyed_seed,
    roll_out,
)

MOST_LANES = 50
"""Most episodes that are stepped together; this many Meta-World lanes take 1 GB and 8 s to create."""

KEPT_BYTES = 2 * 2**30
"""Most memory of simulators that are kept for the next episodes of the same tasks."""


@final
class LaneStage:
    """Runs one episode per lane, at most MOST_LANES at a time; a lane's seeds are keyed by task and position.

    Args:
        environment: of the tasks.
        seed: under which all seeds of episodes are keyed.
        reset, noise: purposes of these seeds.
    """

    def __init__(self, environment: Environment, *, seed: int, reset: Purpose, noise: Purpose) -> None:
        self._environment, self._seed = environment, seed
        self._reset, self._noise = reset, noise
        self._lanes: dict[tuple[int, ...], Lanes] = {}

    def run(
        self,
        tasks: Sequence[Task],
        control: Callable[[slice], Controller],
        *,
        episode: int,
        done: Callable[[int], None],
    ) -> list[Trajectory]:
        """One episode per lane; lanes may repeat tasks.

        Args:
            tasks: of the lanes.
            control: the controller of some of the lanes.
            episode: part of the seeds' keys.
            done: called with the number of episodes that ended.
        """
        name, trajectories = self._environment.name, list[Trajectory]()
        for start in range(0, len(tasks), MOST_LANES):
            chunk = slice(start, start + MOST_LANES)
            keys = [(task.index, episode, start + lane) for lane, task in enumerate(tasks[chunk])]
            trajectories += roll_out(
                self._environment,
                self._lanes_of(tasks[chunk]),
                control(chunk),
                reset_seeds=[
                    keyed_seed(self._seed, name, task, self._reset, *place) for task, *place in keys
                ],
                noise=[keyed_generator(self._seed, name, task, self._noise, *place) for task, *place in keys],
            )
            done(len(keys))
        return trajectories

    def close(self) -> None:
        """Closes all lanes."""
        while self._lanes:
            self._lanes.popitem()[1].close()

    def _lanes_of(self, tasks: Sequence[Task]) -> Lanes:
        """Lanes of the tasks. They are kept, because episodes repeat tasks; the oldest give way."""
        key, environment = tuple(task.index for task in tasks), self._environment
        if key not in self._lanes:
            kept = KEPT_BYTES // max(1, environment.simulator_bytes) - len(key)
            while self._lanes and sum(map(len, self._lanes)) > kept:
                self._lanes.pop(next(iter(self._lanes))).close()
            self._lanes[key] = environment.lanes([task.parameters for task in tasks])
        return self._lanes[key]
