"""Errors that a user can fix. A message is one line: the rule, the value, the place, the remedy."""


class TcmrlError(Exception):
    """A problem with the input or the data; the command line prints it as `Error: …` and exits 2."""


class UnknownNameError(TcmrlError):
    """A name of an environment, behavior source, engine, format or algorithm that does not exist."""


class PluginError(TcmrlError):
    """A plug-in that cannot be used: its import fails, it is of the wrong type, or its name is taken."""


class RecipeError(TcmrlError):
    """A recipe, profile or `--set` override that is not valid."""


class SimulationError(TcmrlError):
    """An environment that cannot be simulated."""


class RenderingError(TcmrlError):
    """An episode that cannot be drawn: no OpenGL, no camera, or a file of a kind that is not written."""


class TaskError(TcmrlError):
    """A task index that does not exist, or a task list that cannot be read."""


class TrajectoryError(TcmrlError):
    """Arrays that do not form an episode."""


class StoreError(TcmrlError):
    """A part on disk whose files, layout or values are not valid."""


class UnreadableError(StoreError):
    """A part that the operating system refuses to read now; it may be sound."""


class ManifestError(TcmrlError):
    """A manifest that is missing, truncated, edited, or has another schema version."""


class SnapshotError(TcmrlError):
    """A policy snapshot that cannot be read or rebuilt."""


class SelectionError(TcmrlError):
    """A selection of tasks, snapshots or trajectories that is empty or not allowed."""


class RequestError(TcmrlError):
    """A batch request with invalid numbers, or with names that contradict each other."""


class BuildError(TcmrlError):
    """A build that cannot start, or whose units failed."""


class StorageError(BuildError):
    """The operating system refused a file operation; data published earlier are unchanged."""


class ReadOnlyError(StorageError):
    """The user may not write to the dataset's folder, or its disk is mounted read-only."""


class RemoteError(TcmrlError):
    """A dataset beyond this disk that cannot be reached, read or written, or is not what it should be."""


class CacheError(TcmrlError):
    """The cache of decoded steps cannot be used, or the text of its size limit is not valid."""


class LockedError(BuildError):
    """Another process is writing to the dataset."""


class NondeterminismError(BuildError):
    """Equal unit settings and seeds produced different data."""


class MissingPackageError(TcmrlError):
    """An optional package is not installed; the message names the extra that installs it."""


class CheckpointError(TcmrlError):
    """A training run that cannot be opened or resumed."""


class TrainingError(TcmrlError):
    """A training run that cannot start, or that diverged."""


class DivergenceError(TrainingError):
    """A training run whose losses or tensors are not finite, or beyond a method's limits."""
