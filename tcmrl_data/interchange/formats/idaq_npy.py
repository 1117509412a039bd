"""The `.npy` files that the published code of FOCAL, IDAQ, CSRO and TCMRL loads.

`goal_idx3/trj_evalsample7_step5000.npy` is episode 7 of task 3's policy after 5,000 steps. It is an object
array of rows [observation, action, reward, next observation], which the loaders open by
`numpy.load(path, allow_pickle=True)` and index as `rows[:, 0]`. They choose files by name (`data_dir`,
`train_epoch` for the step, `n_trj` for the number of episodes) and take the last row of each for the end of
an episode, so that flags, extra arrays and runs have no place.

`tasks.json` beside the folders lists the tasks with their splits and parameters;
`tcmrl-data import idaq-npy FOLDER --tasks FOLDER/tasks.json` reads them back.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import final

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.disk import disk, named_errors
from tcmrl_data.interchange.formats.base import Format
from tcmrl_data.interchange.formats.describing import stored_episodes
from tcmrl_data.interchange.formats.new_folder import REMEDY
from tcmrl_data.interchange.formats.pickled_rows import pickled_rows
from tcmrl_data.store.keys import PartKey
from tcmrl_data.store.tables import task_line

TASKS_FILE = "tasks.json"


@final
class IdaqNpyFormat(Format):
    """One folder per task, one file per episode; an episode without steps is a `StoreError`.

    Episodes of several runs at the same snapshot step are numbered on.
    """

    name = "idaq-npy"

    def place(self, selection: Selection, task: Task) -> str:
        return f"goal_idx{task.index}"

    def write(self, selection: Selection, task: Task, path: Path) -> Iterator[PartKey]:
        with named_errors(path, remedy=REMEDY):
            disk.make_folder(path)
        written: Counter[int] = Counter()
        for key in selection.parts[task.index]:
            for trajectory in stored_episodes(selection.dataset, key, format_name=self.name):
                file = path / f"trj_evalsample{written[key.step]}_step{key.step}.npy"
                with named_errors(file, remedy=REMEDY):
                    disk.write(file, pickled_rows(trajectory))
                written[key.step] += 1
            yield key

    def accompanying(self, selection: Selection) -> Mapping[str, bytes]:
        lines = b",\n".join(task_line(task).strip() for task in selection.tasks)
        return {TASKS_FILE: b"[\n" + lines + b"\n]\n"}
