"""The process of one run of a trial: `python -m tcmrl_algo.tuning.job`, a JSON job on standard input."""

from pathlib import Path
from typing import Any

from tcmrl_algo.experiment.job import Job, run_job
from tcmrl_algo.experiment.results import error_file
from tcmrl_data.engine.worker import Send, serve
from tcmrl_data.foundation.disk import replace_file
from tcmrl_data.foundation.errors import DivergenceError

DIVERGED = "diverged"
"""Instead of a digest, where training diverged; the run's `error.txt` says how."""


def run_trial(job: Job, report: Send) -> str:
    """Does a run, or what is missing of it; the digest of its tensors, or `DIVERGED`.

    Raises:
        TcmrlError: it cannot be trained or evaluated.
    """
    try:
        return run_job(job, report)
    except DivergenceError as error:
        replace_file(error_file(Path(job.folder)), f"{error}\n".encode())
        return DIVERGED


def work(spec: dict[str, Any], report: Send) -> str:
    """Does the run of a job in JSON; the digest of its tensors, or `DIVERGED`."""
    return run_trial(Job.model_validate(spec), report)


if __name__ == "__main__":
    serve(work)
