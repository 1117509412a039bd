"""The errors a user can mend. Each message is one line: the rule, the value, the place, the remedy."""


class TcmrlError(Exception):
    """A problem with the input or the data; the command line prints it as `Error: …` and exits 2."""


class UnknownNameError(TcmrlError):
    """A name of an environment, behavior source, engine, format or algorithm that does not exist."""


class PluginError(TcmrlError):
    """A plug-in that cannot be used: its import fails, it is of the wrong type, or its name is taken."""


class RecipeError(TcmrlError):
    """A recipe, profile or `--set` override that does not validate."""


class TaskError(TcmrlError):
    """A task index that does not exist, or a task list that cannot be read."""


class TrajectoryError(TcmrlError):
    """Arrays that do not form an episode."""


class StoreError(TcmrlError):
    """A part on disk whose files, layout or values are not what they must be."""


class ManifestError(TcmrlError):
    """A manifest that is missing, truncated, edited, or of another schema version."""


class SnapshotError(TcmrlError):
    """A policy snapshot that cannot be rebuilt."""


class SelectionError(TcmrlError):
    """A selection of tasks, snapshots or trajectories that is empty or not allowed."""


class RequestError(TcmrlError):
    """A batch request whose numbers or names do not hold together."""


class BuildError(TcmrlError):
    """A build that cannot start, or units that failed."""


class StorageError(BuildError):
    """The disk refused an operation; what was published before stands."""


class ReadOnlyError(StorageError):
    """The dataset's folder cannot be written by this user, or lies on a disk that is mounted to be read."""


class CacheError(TcmrlError):
    """The cache of decoded steps cannot be used, or a size of it that cannot be read."""


class LockedError(BuildError):
    """Another process works on the dataset."""


class NondeterminismError(BuildError):
    """The same unit settings and seeds gave different data."""


class MissingPackageError(TcmrlError):
    """An optional package that is not installed; the message names the extra that brings it."""


class CheckpointError(TcmrlError):
    """A training run that cannot be opened or resumed."""


class TrainingError(TcmrlError):
    """A training run that cannot start, or that diverged."""
