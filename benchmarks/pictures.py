"""Draws the pictures of the documentation: `python benchmarks/pictures.py DATA [RUN]`.

DATA is a folder of datasets by environment; what is missing there is built, small and with one task. RUN is a
run of `tcmrl train` whose adapted policy is drawn too.
"""

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import tcmrl_data

PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
LARGEST = 60_000
"""Most bytes of a picture."""

SHORT_SAC = (
    "behavior.sac.steps=20000",
    "behavior.sac.snapshots=[0,20000]",
    "behavior.sac.buffer_size=20000",
)
SCRIPTED = ("behavior.source=scripted",)
TASKS: Mapping[str, tuple[int, tuple[str, ...]]] = {
    "point-robot": (30, ()),
    "sparse-point-robot": (60, ()),
    "point-robot-wind": (7, ()),
    "half-cheetah-vel": (3, SHORT_SAC),
    "hopper-rand-params": (1, SHORT_SAC),
    "walker-rand-params": (1, SHORT_SAC),
    "ml1/reach": (3, SCRIPTED),
    "ml1/push": (3, SCRIPTED),
    "ml1/button-press-topdown": (3, SCRIPTED),
}
"""The task that is drawn of each environment, and overrides of the quick recipe that builds it."""


def main() -> None:
    """Draws all pictures."""
    data, *runs = map(Path, sys.argv[1:])
    for name, (task, overrides) in TASKS.items():
        dataset = data / name.replace("/", "-")
        if not dataset.exists():
            recipe = tcmrl_data.load_recipe(name, profile="quick", overrides=overrides)
            report = tcmrl_data.build_dataset(recipe, dataset, tasks=[task], workers=1)
            assert not report.failed, report.failed
        file = PICTURES / f"{name.replace('/', '-')}.webp"
        for frames in (60, 30, 20, 15):
            drawn = tcmrl_data.render_episode(dataset, file, task=task, width=200, frames=frames)
            if drawn.bytes <= LARGEST:
                break
        print(f"{drawn.file.name}: return {drawn.reward:.1f}, {drawn.frames} frames, {drawn.bytes:,} bytes")
    for run in runs:
        plot = ["--protocol", "offline", "--plot", str(PICTURES / "adapted.png")]
        subprocess.run(["tcmrl", "evaluate", str(run), *plot], check=True)


if __name__ == "__main__":
    main()
