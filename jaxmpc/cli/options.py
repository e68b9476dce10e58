"""What a command of the command line is: its words, help, options and the function that does it.

Nothing heavy is imported here, nor before a command asks for it, so that ``--help`` and wrong options answer at once.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable, Mapping
from typing import Any

from jaxmpc.errors import InputError
from jaxmpc.programs import interrupts

EXIT_OPTIMAL, EXIT_OTHER, EXIT_BAD_INPUT, EXIT_INFEASIBLE, EXIT_LIMIT = 0, 1, 2, 3, 4
EXIT_UNREAD = 141  # what shells report for a program that writes to a reader that has left
EXITS = "Exit status: 0 done, 2 bad input, 130 stopped by Ctrl-C, 1 anything else."
PLANTS = ("fmu", "jax")
FAMILIES = {
    "fmu": "Build the well or a controller as an FMU, and look into any FMU.",
    "model": "Step-response models from files of other tools, and for them.",
    "process": "Process files: what studies need to know of a process.",
    "study": "Run studies, look at them, and export their results.",
}
Options = argparse.Namespace
Run = Callable[[Options], int]
Argument = tuple[str, dict[str, Any]]


@dataclasses.dataclass(frozen=True)
class Command:
    """One command: the words that name it, its arguments for `argparse`, what ends its help, and what does it.

    The first paragraph of the function's docstring is its help; it returns the exit status.
    """

    words: str
    arguments: tuple[Argument, ...]
    epilog: str
    run: Run


def command(words: str, *arguments: Argument, epilog: str = "") -> Callable[[Run], Command]:
    """Make a function a command."""
    return lambda run: Command(words, arguments, epilog, run)


def option(name: str, shown: Any, help: str, default: Any, **more: Any) -> Argument:
    """An option (with dashes) or argument that has a value; `shown` stands for it in the help.

    The default gives the type too; a type alone means None unless it is given. `more` is for `argparse`.
    """
    settings = {"metavar": shown, "help": help} | more
    if isinstance(default, type):
        return name, settings | {"type": default}
    kind = type(default[0] if isinstance(default, tuple) else default)
    return name, settings | {"type": kind, "default": default}


def choice(name: str, choices: tuple[Any, ...], help: str, **more: Any) -> Argument:
    """An option with few values, the first of which is its default."""
    return name, {"choices": choices, "type": type(choices[0]), "default": choices[0], "help": help} | more


def switch(name: str, help: str, **more: Any) -> Argument:
    """An option without a value."""
    return name, {"action": "store_true", "help": help} | more


class _Help(argparse.ArgumentDefaultsHelpFormatter):
    """Help with defaults, where there are any."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        return action.help if action.default is None else super()._get_help_string(action)


def parser(commands: Mapping[str, Command]) -> argparse.ArgumentParser:
    """The parser of the command line; what it returns has the command's function as ``run``."""
    plain: dict[str, Any] = {"allow_abbrev": False}
    titles: dict[str, Any] = {"title": "commands", "metavar": "COMMAND", "required": True}
    text = "Model predictive control with discrete actuators."
    whole = argparse.ArgumentParser(prog="jaxmpc", description=text, **plain)
    groups: dict[str, Any] = {"": whole.add_subparsers(**titles)}
    for command in commands.values():
        family, _, name = command.words.rpartition(" ")
        if family not in groups:
            text = FAMILIES[family]
            made = groups[""].add_parser(family, help=text, description=text, **plain)
            groups[family] = made.add_subparsers(**titles)
        text = " ".join((command.run.__doc__ or "").partition("\n\n")[0].split())
        shown: dict[str, Any] = {"help": text, "description": text, "epilog": command.epilog}
        made = groups[family].add_parser(name, **shown, formatter_class=_Help, **plain)
        single = {}  # options that exclude each other, by what they set
        for argument, settings in command.arguments:
            if dest := settings.get("dest"):
                single[dest] = single.get(dest) or made.add_mutually_exclusive_group()
            single.get(dest, made).add_argument(argument, **settings)
        made.set_defaults(run=command.run)
    return whole


def named_number(option: str, text: str) -> tuple[str, float]:
    """``NAME=NUMBER`` taken apart.

    Raises:
        InputError: naming the option.
    """
    name, _, number = text.partition("=")
    try:
        return name, float(number)
    except ValueError:
        raise InputError(option, text, "NAME=NUMBER, such as valve=2") from None


def complain(error: object, status: int) -> int:
    """One line on standard error; returns the status."""
    if not interrupts.being_left():  # an extension that was being loaded makes an error of Ctrl-C
        print("jaxmpc: " + " ".join(str(error).split()), file=sys.stderr)
    return status
