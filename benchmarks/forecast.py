"""Compares forecasts of builds with the builds: `python benchmarks/forecast.py [RECIPE PROFILE ...]`.

Prints JSON: the forecast of every build with its spread, the duration of the build in seconds, and their
ratio. A forecast is correct within a factor of 1.6 on a machine of constant load; the exit code is 1 if one
is not. `--tasks` and `--set` shorten builds that take hours.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import tcmrl_data

FACTOR = 1.6
BUILDS = ["point-robot", "quick", "point-robot-wind", "quick", "half-cheetah-vel", "quick"]


def compare(environment: str, profile: str, arguments: argparse.Namespace) -> dict[str, object]:
    """Plans a build, does it in a temporary folder, and compares."""
    chosen = next(name for name in tcmrl_data.PROFILES if name == profile)
    recipe = tcmrl_data.load_recipe(environment, profile=chosen, overrides=arguments.overrides)
    tasks = None
    if arguments.tasks:
        tasks = tcmrl_data.parse_indices(arguments.tasks, recipe.make_environment().settings.tasks)
    plan = tcmrl_data.forecast_build(tcmrl_data.plan_build(recipe, tasks=tasks), workers=arguments.workers)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "dataset"
        report = tcmrl_data.build_dataset(recipe, out, tasks=tasks, workers=arguments.workers)
    return {
        "environment": environment,
        "profile": profile,
        "workers": plan.workers,
        "seconds": round(plan.seconds, 1),
        "seconds_low": round(plan.seconds_low, 1),
        "seconds_high": round(plan.seconds_high, 1),
        "took": round(report.seconds, 1),
        "ratio": round(report.seconds / plan.seconds, 2),
        "failed": report.failed,
    }


def main() -> None:
    """Compares every build that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("builds", nargs="*", metavar="RECIPE PROFILE", help="pairs of names")
    parser.add_argument("--tasks", help="indices such as 0-9, instead of the profile's choice")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--workers", type=int)
    arguments = parser.parse_args()
    builds = arguments.builds or BUILDS
    pairs = zip(builds[::2], builds[1::2], strict=True)
    results = [compare(environment, profile, arguments) for environment, profile in pairs]
    print(json.dumps({"factor": FACTOR, "builds": results}, indent=2))
    sys.exit(any(not 1 / FACTOR <= result["ratio"] <= FACTOR for result in results))


if __name__ == "__main__":
    main()
