"""Names of commands and options: helps that fit, one meaning per option, an answer for names that went."""

from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from tcmrl_cli.data import data
from tcmrl_cli.groups import GONE, Commands
from tcmrl_cli.train import tcmrl

from tests.commands import assert_refused, in_process
from tests.terminal import as_in_terminal

PROGRAMS = {"tcmrl-data": data, "tcmrl": tcmrl}

MEANINGS = {
    "--accept": "take parts of another platform as they come out",
    "--algo": "a method",
    "--allow-drift": "go on although the platform is another",
    "--allow-test": "take test tasks too",
    "--as": "the name of a run in the new dataset",
    "--behavior": "a source of behavior policies",
    "--build": "build what is missing",
    "--check-published": "compare with the roots of this package",
    "--checkpoint-every": "seconds between two checkpoints",
    "--clean": "remove leftovers",
    "--cross": "a number of near tasks",
    "--data": "the folder of all datasets",
    "--dataset": "the present folder of a dataset that was moved",
    "--deep": "check contents too",
    "--device": "a device of PyTorch",
    "--drop-array": "an array to leave out",
    "--drop-tasks": "tasks that the dataset is to do without",
    "--dry-run": "write nothing",
    "--engine": "what runs the work",
    "--environment": "an environment",
    "--episode": "the number of an episode",
    "--episodes": "how many episodes",
    "--expect-root": "the root that the build should have",
    "--fetched": "what was fetched from addresses",
    "--first-episode": "the number of the first episode",
    "--first-task": "the index of the first file's task",
    "--folds": "a number of folds of the tasks",
    "--format": "the format of what is written",
    "--frames": "a number of pictures",
    "--from": "a copy of the dataset",
    "--held-out": "tasks to hold out",
    "--json": "print one JSON document",
    "--label": "the new dataset's own name",
    "--level": "how deep to compare",
    "--licence": "the licence of imported data",
    "--list": "list what there is",
    "--max-tasks": "most tasks that take part",
    "--memory-limit": "most memory for data",
    "--metric": "a metric of training",
    "--min-return": "the least return of an episode",
    "--move": "let a tag name another dataset",
    "--names": "names of several datasets",
    "--noise": "the standard deviation of noise on actions",
    "--only": "the method to run",
    "--option": "an option of an import format",
    "--out": "where to write",
    "--plan": "only say what the work takes",
    "--plot": "a picture to draw",
    "--price-per-1000-requests": "what 1,000 requests to a store cost",
    "--price-per-gb": "what a gigabyte in a store costs",
    "--profile": "a profile of the recipe",
    "--protocol": "a protocol of adaptation",
    "--quick": "check names and sizes alone",
    "--quiet": "print results and errors only",
    "--random-episodes": "how many adaptation episodes are random",
    "--ray-address": "the address of a Ray cluster",
    "--recipe": "only print the recipe",
    "--repair": "make damaged parts again",
    "--repeats": "how many times a protocol is run",
    "--replay": "how many parts are replayed",
    "--resume": "go on from the newest checkpoint",
    "--rows": "a table of results to add rows to",
    "--run": "the run of the dataset that is read",
    "--sample": "how many parts are opened",
    "--seed": "a seed",
    "--seeds": "seeds of runs",
    "--set": "a setting and its value",
    "--snapshots": "a rule that chooses snapshots",
    "--source": "a dataset with parts that others were made from",
    "--split": "the split whose tasks are taken",
    "--split-from": "the dataset whose split is taken",
    "--step": "the training step of a snapshot",
    "--steps": "training steps of every run, to which schedules are scaled",
    "--stop-at": "the training step to stop at; schedules stay",
    "--strict": "what else is a note is an error",
    "--tag": "a name for a state of a dataset",
    "--task": "the index of a task",
    "--task-file": "a file that describes tasks",
    "--tasks": "indices of the tasks that are taken",
    "--tier": "a quality tier",
    "--to": "tasks whose rewards are wanted",
    "--transfer": "play every policy in every task",
    "--trials": "a number of trials",
    "--tuned": "tunings whose best settings are taken",
    "--url": "where imported data come from",
    "--version": "print the version",
    "--view": "where to write a view",
    "--viewer": "write Parquet for the viewer of the Hub",
    "--watch": "steps between two looks at a run",
    "--width": "the width of a picture",
    "--workers": "how many processes work at once",
    "--yes": "do not ask",
}
"""What each option means, in every command that has it."""


def commands(command: click.Command, *path: str) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """A command and those below it, with their paths."""
    yield path, command
    for name, below in getattr(command, "commands", {}).items():
        yield from commands(below, *path, name)


ALL = [found for name, program in PROGRAMS.items() for found in commands(program, name)]


def options() -> Iterator[tuple[str, str, click.Option]]:
    for path, command in ALL:
        for parameter in command.params:
            if isinstance(parameter, click.Option):
                yield parameter.opts[0], " ".join(path), parameter


def test_every_option_has_one_meaning() -> None:
    assert sorted({name for name, _, _ in options()}) == sorted(MEANINGS)


@pytest.mark.parametrize("name", MEANINGS)
def test_the_values_of_an_option_are_of_one_kind_in_all_commands(name: str) -> None:
    kinds = {
        "flag" if option.is_flag else str(option.metavar or type(option.type).__name__)
        for option_name, _, option in options()
        if option_name == name
    }
    alike = {"--out": {"FOLDER", "FILE", "PATH"}, "--episodes": {"N", "IntRange"}}
    assert len(kinds) == 1 or kinds <= alike.get(name, {"PluginName", "Choice"}), kinds


def test_the_argument_is_called_dataset_everywhere() -> None:
    named = {
        (parameter.name, parameter.make_metavar(click.Context(command)))
        for _, command in ALL
        for parameter in command.params
        if isinstance(parameter, click.Argument)
    }
    assert {metavar for name, metavar in named if name in ("dataset", "left")} == {"DATASET"}
    assert {metavar for _, metavar in named} == {
        *("DATASET", "OTHER", "DATASET…", "ENV|FILE", "URL", "OUT", "FORMAT", "FILE…", "[FOLDER]"),
        *("RUN", "RUNS...", "FILE|NAME", "NAME"),
    }


@pytest.mark.parametrize(("path", "command"), ALL, ids=[" ".join(path) for path, _ in ALL])
def test_every_help_fits_80_columns_with_whole_summaries(
    path: tuple[str, ...], command: click.Command
) -> None:
    program, *words = path
    shown = as_in_terminal(PROGRAMS[program], *words, "--help")
    assert shown.code == 0
    assert all(len(line) <= 80 for line in shown.output.splitlines())
    assert "..." not in shown.output.replace("RUNS...", "").replace("[ARGS]...", "")
    flat = " ".join(shown.output.split())
    for below in getattr(command, "commands", {}).values():
        sentence = " ".join((below.help or "").split("\n\n")[0].split())
        assert sentence.removesuffix(".") in flat


@pytest.mark.parametrize("name", GONE)
def test_a_name_that_went_says_what_to_use(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    program, *words = name.split(" ")
    call = in_process(PROGRAMS[program], capsys)
    typed = words if words[-1].startswith("-") else [*words, "data/demo", "--json"]
    assert_refused(call(*typed), f"`{name}` is gone; use {GONE[name]}")
    command: click.Command = PROGRAMS[program]
    for word in GONE[name].split(" ")[1:]:
        if not isinstance(command, Commands) or not GONE[name].startswith(program):
            break
        assert word in command.commands
        command = command.commands[word]


def test_a_dataset_in_place_of_a_command_is_answered_with_the_command_to_choose(
    tiny_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    call = in_process(data, capsys)
    assert_refused(call("inspect", tiny_folder), "`tcmrl-data inspect returns|tasks|", f"{tiny_folder}`")
    assert_refused(call(tiny_folder), "`tcmrl-data build|new|import|", f"card {tiny_folder}`")
