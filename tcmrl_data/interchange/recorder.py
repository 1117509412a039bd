"""Recording: what happens in a Gymnasium environment becomes a dataset while it happens."""

import contextlib
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn, SupportsFloat, final

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box

from tcmrl_data.envs.base import Split, Task
from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.disk import CHECKPOINTS, STAGING, remove_tree, replace_file
from tcmrl_data.foundation.errors import ManifestError, StoreError
from tcmrl_data.foundation.records import digest
from tcmrl_data.interchange.importing import recipe_of_episodes
from tcmrl_data.interchange.reader import EpisodeCuts, episode_of
from tcmrl_data.operations.assembly import derivation_of, open_assembly
from tcmrl_data.parts.making import make_part
from tcmrl_data.parts.operation import WantedPart
from tcmrl_data.recipe.imported import check_licence
from tcmrl_data.store.archive import Archive
from tcmrl_data.store.arrays import read_arrays, unpack
from tcmrl_data.store.manifest import Run
from tcmrl_data.store.part import STANDARD_ARRAYS, PartRecord
from tcmrl_data.store.tables import MAIN_RUN, PartKey, key_of_file, part_folder


@final
class DatasetRecorder(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Records all episodes of an environment as one task of a new dataset, which exists after `close`.

    Every `part_episodes` episodes become a part, whose step is the number of environment steps before it.
    Every finished episode is on disk before `step` returns. After a crash, a recorder with the same arguments
    goes on behind the last finished episode: only the open one is lost. An episode that `reset` ends early is
    marked as truncated. The policy and the seed are not known and stay open.

    `Recorder` is another thing: it collects lanes in memory, for rollouts.

    Args:
        env: with observations and actions of rank 1, actions in [-1, 1].
        out: the new dataset's folder.
        part_episodes: number of episodes of a part.
        horizon: most steps of an episode; that of the environment's specification where None.
        environment: one of ours that `env` is; otherwise the dataset's environment is `foreign`.
        task: index of the task.
        split: of the task.
        parameters: of the task.
        label: the dataset's own name.
        licence: of the data, an SPDX expression.
        url: where the environment or the data are described.

    Raises:
        StoreError: the spaces are of another form, there is no horizon, or `out` is in use.
        LockedError: another recorder writes to the folder.

    Example:
        >>> import gymnasium, tcmrl_data
        >>> env = gymnasium.wrappers.RescaleAction(gymnasium.make("Pendulum-v1"), -1.0, 1.0)  # doctest: +SKIP
        >>> with tcmrl_data.DatasetRecorder(env, "data/pendulum") as recorder:  # doctest: +SKIP
        ...     observation, info = recorder.reset(seed=0)
        ...     for _ in range(1_000):
        ...         *_, terminated, truncated, _ = recorder.step(recorder.action_space.sample())
        ...         if terminated or truncated:
        ...             recorder.reset()
        >>> tcmrl_data.open_dataset("data/pendulum")  # doctest: +SKIP
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        out: str | Path,
        *,
        part_episodes: int = 50,
        horizon: int | None = None,
        environment: str | None = None,
        task: int = 0,
        split: Split = "train",
        parameters: Mapping[str, Any] | None = None,
        label: str | None = None,
        licence: str | None = None,
        url: str | None = None,
    ) -> None:
        super().__init__(env)
        if part_episodes < 1:
            raise StoreError(f"part_episodes must be 1 or more, got {part_episodes}")
        check_licence(licence)
        self._horizon = _horizon(env, horizon)
        self._out, self._part_episodes, self._label = Path(out), part_episodes, label
        self._task = Task(task, split, dict(parameters or {}))
        self._recipe, _ = recipe_of_episodes(
            environment,
            tasks=[self._task],
            sizes=_sizes(env),
            horizon=self._horizon,
            extras={},
            licence=licence,
        )
        name = None if env.spec is None else env.spec.id
        origin = {"format": "recording", "environment": name, "licence": licence, "url": url}
        self._run = Run(
            name=MAIN_RUN, kind="recorded", seed=None, recipe=self._recipe, origin=origin, steps=None
        )
        settings = {
            "origin": digest(origin),
            "recipe": digest(self._recipe.unit_settings()),
            "task": digest([task, split, self._task.parameters]),
            "part_episodes": part_episodes,
        }
        self._stack = contextlib.ExitStack()
        self._assembly = self._stack.enter_context(
            open_assembly(self._out, derivation_of("record", settings, []), [])
        )
        self._observations: list[npt.NDArray[Any]] = []
        self._actions: list[npt.NDArray[Any]] = []
        self._rewards: list[float] = []
        self._closed = False
        try:
            self._take_up()
        except BaseException:
            self._stack.close()
            raise

    @property
    def episodes(self) -> int:
        """Number of finished episodes, those of earlier attempts too."""
        return self._published_episodes + len(self._open)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode; one that is open ends as truncated."""
        self._end_episode(terminated=False, truncated=True)
        observation, info = self.env.reset(seed=seed, options=options)
        self._observations = [np.array(observation)]
        return observation, info

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """One step; where it ends an episode, that is on disk afterwards.

        Raises:
            StoreError: the episode is longer than the horizon, or holds values that a dataset may not have.
            StorageError: the disk refuses; the episodes before are kept.
        """
        taken = np.array(action)
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._observations.append(np.array(observation))
        self._actions.append(taken)
        self._rewards.append(float(reward))
        if len(self._actions) > self._horizon:
            self._actions.clear()  # the episode is lost, those before it are not
            raise StoreError(f"{self._out}: an episode is longer than the horizon of {self._horizon} steps")
        if terminated or truncated:
            self._end_episode(terminated=bool(terminated), truncated=bool(truncated))
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Publishes what is left and makes the dataset; closing twice does no harm.

        Without a finished episode there is no dataset; a recorder with the same arguments goes on.
        """
        if self._closed:
            return
        self._closed = True
        with self._stack:
            self._end_episode(terminated=False, truncated=True)
            self._publish()
            if self._published_episodes:
                self._assembly.finish(runs=[self._run], tasks=[self._task], label=self._label)
                remove_tree(self._out / CHECKPOINTS)
        self.env.close()

    def _take_up(self) -> None:
        """Counts the parts and reads the open part's finished episodes that an earlier attempt left."""
        self._published_episodes = self._published_steps = 0
        folder = self._out / part_folder(PartKey(self._task.index, 0))
        for file in sorted(folder.glob("*.zip")):
            key = key_of_file(file.relative_to(self._out).as_posix())
            if key is not None:
                entry = self._assembly.write(key, functools.partial(_refuse, file))
                self._published_episodes += entry.episodes
                self._published_steps += entry.steps
        self._open: list[Trajectory] = []
        while (file := self._file(self.episodes)).is_file():
            try:
                with Archive(file) as archive:
                    self._open += unpack(read_arrays(archive, STANDARD_ARRAYS))
            except (StoreError, ManifestError):
                break  # damaged: recording goes on in its place
        if len(self._open) >= self._part_episodes:
            self._publish()

    def _end_episode(self, *, terminated: bool, truncated: bool) -> None:
        """Writes the open episode, if it has a step."""
        observations, actions, rewards = self._observations, self._actions, self._rewards
        self._observations, self._actions, self._rewards = [], [], []
        if not actions:
            return
        place = f"{self._out}: episode {self.episodes}"
        made = episode_of(
            np.stack(observations),
            np.stack(actions),
            np.array(rewards),
            ended=(terminated, truncated),
            cuts=EpisodeCuts(),
            place=place,
        )
        replace_file(self._file(self.episodes), self._make([made])[1], staging=self._out / STAGING)
        self._open.append(made)
        if len(self._open) >= self._part_episodes:
            self._publish()

    def _publish(self) -> None:
        """Publishes the open part; its episodes' files go only then."""
        if not self._open:
            return
        first, trajectories = self._published_episodes, self._open
        step = self._published_steps
        self._assembly.write(PartKey(self._task.index, step), functools.partial(self._make, trajectories))
        self._published_episodes += len(trajectories)
        self._published_steps += sum(map(len, trajectories))
        self._open = []
        for number in range(first, self._published_episodes):
            self._file(number).unlink(missing_ok=True)

    def _make(self, trajectories: list[Trajectory]) -> tuple[PartRecord, bytes]:
        return make_part(
            WantedPart(settings=self._recipe.unit_settings(), task=self._task, step=self._published_steps),
            trajectories,
        )

    def _file(self, number: int) -> Path:
        return self._out / CHECKPOINTS / f"episode_{number:07d}.zip"


def _refuse(file: Path) -> NoReturn:
    raise StoreError(f"{file} is damaged; delete it to record without its episodes")


def _sizes(env: gymnasium.Env[Any, Any]) -> tuple[int, int]:
    """Widths of observations and actions.

    Raises:
        StoreError: other spaces than arrays of rank 1, or other actions than in [-1, 1].
    """
    observations, actions = env.observation_space, env.action_space
    if not isinstance(observations, Box) or len(observations.shape) != 1:
        raise StoreError(
            f"observations are {observations}, not of rank 1; wrap the environment in FlattenObservation"
        )
    if not isinstance(actions, Box) or len(actions.shape) != 1:
        raise StoreError(f"actions are {actions}, not arrays of rank 1; others cannot be stored")
    if (actions.low != -1.0).any() or (actions.high != 1.0).any():
        raise StoreError(
            f"actions lie in [{actions.low.min():g}, {actions.high.max():g}], those of a dataset in [-1, 1]; "
            "wrap the environment in RescaleAction(environment, -1, 1)"
        )
    return observations.shape[0], actions.shape[0]


def _horizon(env: gymnasium.Env[Any, Any], horizon: int | None) -> int:
    found = horizon if horizon is not None or env.spec is None else env.spec.max_episode_steps
    if found is None or found < 1:
        raise StoreError(
            f"the environment has no time limit ({found}); pass horizon=N, the most steps of an episode"
        )
    return found
