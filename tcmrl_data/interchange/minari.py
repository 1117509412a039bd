"""Minari, one dataset per task, named `tcmrl/<environment>/task00007-<snapshots>-v0`.

The folder is a root of Minari datasets: with MINARI_DATASETS_PATH naming it, `minari.load_dataset` opens
them by their names. Episodes are ordered by snapshot; every episode has the seed of its environment's
reset, and as metadata its snapshot's step. Further arrays such as `success` are infos with one row
more than actions, as Minari has them: the first row is of the reset.

`ref_min_score` is the return of uniform actions; `ref_max_score` that of a controller that knows the task,
else of the environment's expert, else of the best snapshot, and `ref_max_score_source` says of which. Data
that were imported have neither. The metadata have under `tcmrl` a JSON object that names task and dataset.
`recover_environment` gives the task back as a Gymnasium environment.

Datasets are read without Minari, from `data/metadata.json` and `data/main_data.hdf5`; each is one task.
Observations and actions are arrays, or a flat dictionary of arrays, which are put side by side. Infos of
rank 1 become further per-step arrays without their first row, which is the reset's; others are left out.
"""

import contextlib
import json
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from gymnasium.utils import RecordConstructorArgs

from tcmrl_data.dataset.dataset import Dataset, TaskReferences
from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.base import ENVIRONMENTS, Environment, Task, make_environment
from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.files import one_line, read_plain_file
from tcmrl_data.foundation.records import MAX_JSON_BYTES, parse_json
from tcmrl_data.foundation.seeding import Purpose, keyed_seed
from tcmrl_data.interchange.exporting import Format
from tcmrl_data.interchange.hdf5_file import Hdf5File, new_file, write_array
from tcmrl_data.interchange.reader import (
    EpisodeCuts,
    FileTask,
    ObservationOptions,
    Reader,
    ReadPart,
    Say,
    described_task,
    parts_of_task,
    require_file,
    stored_episode,
)
from tcmrl_data.recipe.document import AND
from tcmrl_data.store.part import Platform
from tcmrl_data.store.tables import PartKey

if TYPE_CHECKING:
    import h5py

METADATA_KEY = "tcmrl"
STEP_ATTRIBUTE = "snapshot_step"
METADATA, CONTENT = "metadata.json", "main_data.hdf5"


@final
class MinariFormat(Format):
    """One Minari dataset per task; an episode without steps is a `StoreError`.

    While a dataset is written, MINARI_DATASETS_PATH of this process names another folder.

    Example:
        >>> import minari  # doctest: +SKIP
        >>> minari.load_dataset("tcmrl/point-robot/task00000-last-v0")  # doctest: +SKIP
    """

    name = "minari"
    optional_packages = ("minari",)
    extra = "tcmrl[minari]"

    def place(self, selection: Selection, task: Task) -> str:
        return dataset_id(selection.dataset, task.index, selection.rule)

    def write(self, selection: Selection, task: Task, path: Path) -> Iterator[PartKey]:
        import minari

        dataset, name = selection.dataset, self.place(selection, task)
        with _datasets_path(path.parents[name.count("/")]):
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", ".* (is set to|is) None", UserWarning)  # what is unknown
                written = minari.create_dataset_from_buffers(name, [], **_description(selection, task))
            source, _ = _best(dataset.references(task.index))
            written.storage.update_metadata(
                {"ref_max_score_source": source, METADATA_KEY: json.dumps(self.attributes(selection, task))}
            )
            episodes = steps = 0
            with new_file(content := path / "data" / CONTENT, "w") as file:
                for key, trajectories in self.parts(selection, task, content):
                    for index, trajectory in enumerate(trajectories):
                        group = file.create_group(f"episode_{episodes}")
                        group.attrs.update({"id": episodes, "total_steps": len(trajectory)})
                        _write_episode(group, dataset, key, index, trajectory)
                        episodes, steps = episodes + 1, steps + len(trajectory)
                    file.flush()  # what the file keeps in memory is counted as room otherwise
                    yield key
            written.storage.update_metadata({"total_episodes": episodes, "total_steps": steps})
            written.storage.update_metadata({"dataset_size": written.storage.get_size()})

    def accompanying(self, selection: Selection) -> Mapping[str, bytes]:
        namespace = Path(self.place(selection, selection.tasks[0])).parent
        folders = [folder for folder in (namespace, *namespace.parents) if folder.name]
        return {f"{folder}/namespace_metadata.json": b"{}" for folder in folders}


def dataset_id(dataset: Dataset, task: int, snapshots: str = "all") -> str:
    """The name of a task's Minari dataset; a rule's `>=` and `.` become `-ge-` and `_`."""
    rule = snapshots.replace(" ", "").replace(">=", "-ge-").replace(".", "_").replace(":", "-")
    return f"tcmrl/{dataset.name}/task{task:05d}-{rule}-v0"


def make_task(settings: Mapping[str, Any], parameters: Mapping[str, Any]) -> gymnasium.Env[Any, Any]:
    """The entry point by which Gymnasium makes an exported task again, with the float32 of its dataset.

    Args:
        settings: the recipe's `[environment]` table.
        parameters: of the task.
    """
    return Float32Observations(make_environment(settings).make(parameters))


class Float32Observations(gymnasium.ObservationWrapper[Any, Any, Any], RecordConstructorArgs):
    """Observations in the precision of the dataset; environments themselves give float64."""

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        RecordConstructorArgs.__init__(self)
        gymnasium.ObservationWrapper.__init__(self, env)
        self.observation_space = _observation_space(*(env.observation_space.shape or ()))

    def observation(self, observation: npt.NDArray[np.floating]) -> npt.NDArray[np.float32]:
        """The observation as float32."""
        return observation.astype(np.float32)


def _observation_space(*shape: int) -> Box:
    return Box(-np.inf, np.inf, shape, np.float32)


@contextlib.contextmanager
def _datasets_path(folder: Path) -> Iterator[None]:
    """Makes a folder the root of Minari's datasets; Minari takes it from the process's environment only."""
    before = os.environ.get("MINARI_DATASETS_PATH")
    os.environ["MINARI_DATASETS_PATH"] = str(folder.resolve())  # Minari trips over a relative one
    try:
        yield
    finally:
        del os.environ["MINARI_DATASETS_PATH"]
        if before is not None:
            os.environ["MINARI_DATASETS_PATH"] = before


def _description(selection: Selection, task: Task) -> dict[str, Any]:
    """Metadata of a task's Minari dataset."""
    dataset = selection.dataset
    environment, recipe = dataset.environment, dataset.manifest.recipe
    spec = None
    if type(environment).members():  # otherwise only its data are known
        settings = recipe.environment.model_dump(mode="json")
        spec = EnvSpec(
            id=f"tcmrl/{dataset.name.replace('/', '-')}-task{task.index:05d}-v0",
            entry_point=f"{__name__}:{make_task.__name__}",
            kwargs={"settings": settings, "parameters": dict(task.parameters)},
        )
    references = dataset.references(task.index)
    platform = dataset.manifest.platforms[dataset.entry(selection.parts[task.index][0]).platform]
    return {
        "env": spec,
        "eval_env": spec,
        "observation_space": _observation_space(environment.observation_dim),
        "action_space": Box(-1.0, 1.0, (environment.action_dim,), np.float32),
        "algorithm_name": recipe.behavior.source,
        "ref_min_score": references.uniform,
        "ref_max_score": None if references.uniform is None else _best(references)[1],
        "num_episodes_average_score": recipe.rollouts.episodes,
        "requirements": _requirements(environment, platform),
        "description": (
            f"Task {task.index} of {dataset.name} ({task.split}), parameters "
            f"{json.dumps(dict(task.parameters), sort_keys=True)}. {recipe.about.description} "
            f"Source: {recipe.about.citation}. Licence: {AND.join(dataset.manifest.licences)}. "
            f"Exported from the dataset with root {dataset.manifest.root}."
        ),
    }


def _requirements(environment: Environment, platform: Platform) -> list[str]:
    """The packages without which a task cannot be made again, as they were when its data were."""
    provider = ENVIRONMENTS.provider(environment.name.partition("/")[0])
    simulator = platform.physics.get("versions")
    names = ("gymnasium", provider, *(simulator if isinstance(simulator, Mapping) else ()))
    versions = {"tcmrl": version("tcmrl"), **platform.packages}
    return [f"{name}=={versions[name]}" for name in dict.fromkeys(["tcmrl", *names]) if name in versions]


def _best(references: TaskReferences) -> tuple[str, float]:
    """The source of the highest reference score, and the score."""
    if references.oracle is not None:
        return "oracle", references.oracle
    if references.scripted is not None:
        return "scripted", references.scripted
    return "behavior", references.behavior


def _write_episode(
    group: "h5py.Group", dataset: Dataset, key: PartKey, index: int, trajectory: Trajectory
) -> None:
    """Writes an episode as Minari's HDF5 storage does, but its arrays compressed."""
    seed = dataset.part(*key).identity.seed
    if seed is not None:
        group.attrs["seed"] = keyed_seed(seed, dataset.name, key.task, Purpose.ROLLOUT_RESET, key.step, index)
    group.attrs[STEP_ATTRIBUTE] = key.step
    arrays = {
        "observations": trajectory.observations,
        "actions": trajectory.actions,
        "rewards": trajectory.rewards,
        "terminations": trajectory.terminated,
        "truncations": trajectory.truncated,
    }
    for name, values in arrays.items():
        write_array(group, name, values)
    infos = group.create_group("infos")
    for name, values in trajectory.extras.items():
        write_array(infos, name, np.concatenate([np.zeros(1, values.dtype), values]))


@final
class MinariReader(Reader):
    """A path is the folder of a dataset, such as `~/.minari/datasets/mujoco/hopper/medium-v0`."""

    name = "minari"
    Options = ObservationOptions
    options: ObservationOptions

    def files(self, path: Path) -> list[Path]:
        for folder in (path / "data", path):
            if (folder / METADATA).is_file():
                files = [folder / name for name in (CONTENT, METADATA)]
                for file in files:
                    require_file(file)
                return files
        raise StoreError(f"{path}: holds no data/{METADATA}; name the folder of a Minari dataset")

    def read(self, path: Path, say: Say | None = None) -> Iterator[ReadPart]:
        content, metadata = self.files(path)
        task = _task(metadata)
        cuts = EpisodeCuts()
        with Hdf5File(content) as file:
            episodes = (
                (
                    file.step(f"/{name}", STEP_ATTRIBUTE),
                    stored_episode(
                        _arrays(file, f"/{name}", self.options.keys()), cuts=cuts, place=f"{content}: /{name}"
                    ),
                )
                for name in file.numbered("/", "episode_")
            )
            yield from parts_of_task(episodes, task, place=str(content))
        cuts.tell(say, path)


def _arrays(file: Hdf5File, group: str, keys: Sequence[str] | None) -> dict[str, npt.NDArray[Any]]:
    """The arrays of an episode by the names of `Trajectory`; infos without the row of the reset."""
    actions = file.columns(f"{group}/actions", None)
    infos = f"{group}/infos"
    names = [name for name in file.members(infos) if file.rank(f"{infos}/{name}") == 1]
    further = {name: file.array(f"{infos}/{name}") for name in names}
    further = {
        name: values[1:] if len(values) == len(actions) + 1 else values for name, values in further.items()
    }
    return {
        **{name: values for name, values in further.items() if len(values) == len(actions)},
        "observations": file.columns(f"{group}/observations", keys),
        "actions": actions,
        "rewards": file.array(f"{group}/rewards"),
        "terminated": file.array(f"{group}/terminations"),
        "truncated": file.array(f"{group}/truncations"),
    }


def _task(file: Path) -> FileTask:
    """The task of a dataset that was exported here; nothing for any other."""
    try:
        values = parse_json(read_plain_file(file, limit=MAX_JSON_BYTES).replace(b"Infinity", b"0"))
        if not isinstance(values, dict):
            raise ValueError("no table")
    except (OSError, ValueError) as error:
        raise StoreError(f"{file}: not Minari's metadata ({one_line(error)})") from None
    if values.get("data_format", "hdf5") != "hdf5":
        found = repr(values["data_format"])[:40]
        raise StoreError(
            f"{file}: data_format is {found}, only hdf5 is read; convert the dataset with Minari"
        )
    text = values.get(METADATA_KEY)
    return FileTask() if text is None else described_task(text, place=str(file))
