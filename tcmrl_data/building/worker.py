"""The process of one unit of a build: `python -m tcmrl_data.building.worker`, a JSON spec on its input."""

from typing import Any

from tcmrl_data.building.unit import UnitSpec, run_unit
from tcmrl_data.engine.worker import Send, serve


def work(spec: dict[str, Any], report: Send) -> str:
    """Makes and publishes the parts of a unit; the digest of their ids."""
    import torch

    torch.set_num_threads(1)  # digests depend on it: reductions split by thread round differently
    return run_unit(UnitSpec.from_json(spec), report)


if __name__ == "__main__":
    serve(work)
