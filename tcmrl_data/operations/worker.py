"""The process that makes parts from stored ones: `python -m tcmrl_data.operations.worker`."""

from typing import Any

from tcmrl_data.engine.worker import Send, serve
from tcmrl_data.operations.publishing import publish_parts
from tcmrl_data.operations.remaking import RemakeSpec


def work(spec: dict[str, Any], report: Send) -> str:
    """Makes and publishes the parts of some jobs; the digest of their ids."""
    import torch

    torch.set_num_threads(1)  # digests depend on it: reductions split by thread round differently
    return publish_parts(RemakeSpec.from_json(spec), report)


if __name__ == "__main__":
    serve(work)
