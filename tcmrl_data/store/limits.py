"""How large a dataset may become: what every reader takes and every writer keeps to.

Readers refuse larger records before they allocate memory for them. Writers check the plan of a dataset with
`check_plan` before the work starts, so that no dataset grows until it can no longer be opened.
"""

from tcmrl_data.foundation.errors import BuildError

MAX_PARTS = 1_000_000
MAX_TASKS = 100_000
MAX_STEPS = 2**14
"""Snapshot steps of a run; the manifest and every part's record list them."""
MAX_RUNS = 1_000
MAX_PLATFORMS = 1_000

MAX_INDEX = 2**31
"""Task indices and snapshot steps lie below this."""

MAX_COUNT = 2**40
"""Numbers of episodes, steps and bytes lie below this."""

MAX_ARRAYS = 32
MAX_COLUMNS = 2**14
"""Width of observations and actions; a part's record holds two sums per column."""

LINE_BYTES = 2**16
"""A line of a table; the parameters of a task must fit into it."""

PART_RECORD_BYTES = 2**21


def check_plan(*, tasks: int, steps: int, columns: int, largest_task: int) -> None:
    """Checks that a dataset will not become larger than readers allow.

    Args:
        tasks: number of tasks.
        steps: number of snapshot steps of every task.
        columns: width of observations or actions, whichever is larger.
        largest_task: bytes of the longest line of a task.

    Raises:
        BuildError: names the limit and what exceeds it.
    """
    for what, found, limit in (
        ("tasks", tasks, MAX_TASKS),
        ("snapshot steps", steps, MAX_STEPS),
        ("parts", tasks * steps, MAX_PARTS),
        ("columns of observations or actions", columns, MAX_COLUMNS),
        ("bytes for the parameters of one task", largest_task, LINE_BYTES),
    ):
        if found > limit:
            raise BuildError(
                f"the dataset would have {found:,} {what}, more than the {limit:,} that a dataset may have"
            )
