"""SEPTIC configurations, ``.cnfg``: blocks ``Type:  Name`` of ``Attribute=  values``, read whole with lines, and written.

Public is the form, from the editor extension in github.com/equinor/vscode-septic (MIT). `septic` gives the blocks a meaning.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from identify.foreign.common import number, read_text
from jaxmpc.errors import InputError

TOKENS = re.compile(
    r"""(?P<space>\s+)
    | (?P<comment>//[^\r\n]* | /\*.*?\*/ | \{\#.*?\#\})
    | (?P<template>\{[{%])
    | "(?P<string>[^"]*)"
    | (?P<head>[A-Za-z_]\w*):(?=\s|$)
    | (?P<key>[A-Za-z_]\w*)=
    | (?P<word>(?:(?!//|/\*|\{[\#{%])[^\s"])+)""",
    re.VERBOSE | re.DOTALL,
)
SWALLOWED = re.compile(r"\n\s*[A-Za-z_]\w*[=:]\s")  # an attribute or a head in what is no text
KEY_WIDTH, HEAD_WIDTH, PER_LINE = 14, 15, 8


class Text(str):
    """A value that stands in quotes."""


@dataclasses.dataclass(frozen=True)
class Attribute:
    """An attribute with its values as they stand, without quotes.

    Attributes:
        line: of its name.
    """

    name: str
    values: tuple[str, ...]
    line: int = 0

    @property
    def text(self) -> str:
        """Its values in one line."""
        return " ".join(f'"{value}"' if isinstance(value, Text) else value for value in self.values)


@dataclasses.dataclass(frozen=True)
class Block:
    """An object: type, name, attributes, and the file and line of its head."""

    kind: str
    name: str
    attributes: tuple[Attribute, ...]
    file: str = ""
    line: int = 0

    @property
    def where(self) -> str:
        """File and line."""
        return f"{self.file}:{self.line}"

    def place(self, attribute: Attribute) -> str:
        """File and line of one of its attributes."""
        return f"{self.file}:{attribute.line}"

    def find(self, *names: str) -> Attribute | None:
        """The attribute with one of the names."""
        return next((a for a in self.attributes if a.name in names), None)

    def number(self, name: str, what: str, default: float) -> float:
        """The value of an attribute that is one number."""
        found = self.find(name)
        return default if found is None else self.number_of(found, what)

    def number_of(self, found: Attribute, what: str) -> float:
        """The number that an attribute is."""
        if len(found.values) != 1 or isinstance(found.values[0], Text):
            raise InputError(self.place(found), f"{found.name}= {found.text}", f"one number: {what}")
        return number(found.values[0], self.place(found), what)

    def word(self, name: str, default: str) -> str:
        """The value of an attribute that is one word or text."""
        found = self.find(name)
        if found is None:
            return default
        if len(found.values) != 1:
            raise InputError(self.place(found), f"{found.name}= {found.text}", "one value")
        return str(found.values[0])

    def numbers(self, name: str, what: str) -> list[float]:
        """The values of an attribute that is a list: its length, then as many numbers; empty if it is not there."""
        found = self.find(name)
        if found is None:
            return []
        where, shown = self.place(found), f"{found.name}= {found.text}"
        if not found.values or not found.values[0].isdecimal():
            raise InputError(where, shown, f"how many follow, then {what}")
        if len(found.values) != int(found.values[0]) + 1:
            expected = f"{found.values[0]} numbers after their count: {what}"
            raise InputError(where, f"{shown} ({len(found.values) - 1} numbers)", expected)
        return [number(value, where, what) for value in found.values[1:]]


def read_file(path: Path) -> list[Block]:
    """The blocks of a file in its order."""
    return parsed(read_text(path), str(path))


def parsed(text: str, file: str = "") -> list[Block]:
    """The blocks of a configuration.

    Raises:
        InputError: with file and line, for a quote that does not end, a value without an attribute, an attribute without a
            block, and templates, from which a configuration has yet to be made.
    """
    blocks: list[Block] = []
    attributes: list[Attribute] = []
    values: list[str] = []
    head: tuple[str, str, int] | None = None
    key: tuple[str, int] | None = None

    def close_attribute() -> None:
        nonlocal key
        if key is not None:
            attributes.append(Attribute(key[0], tuple(values), key[1]))
        values.clear()
        key = None

    def close_block() -> None:
        close_attribute()
        if head is not None:
            blocks.append(Block(head[0], head[1], tuple(attributes), file, head[2]))
        attributes.clear()

    for kind, value, line in _tokens(text, file):
        where = f"{file}:{line}"
        if kind == "head":
            close_block()
            head = (value, "", line)
        elif kind == "key":
            close_attribute()
            if head is None:
                raise InputError(where, f"{value}=", "a block first, such as 'Mvr:  Name'")
            key = (value, line)
        elif key is not None:
            values.append(Text(value) if kind == "string" else value)
        elif head is not None and not head[1]:
            head = (head[0], value, head[2])
        else:
            raise InputError(where, value, "'Type:  Name', or 'Attribute= value' in a block")
    close_block()
    for block in blocks:
        if not block.name:
            raise InputError(block.where, f"{block.kind}:", "a name after the type")
    return blocks


def _tokens(text: str, file: str) -> Iterator[tuple[str, str, int]]:
    """Kind, text and line of everything but spaces and comments."""
    at, line = 0, 1
    while at < len(text):
        match = TOKENS.match(text, at)
        where = f"{file}:{line}"
        if match is None:
            rest = text[at:].split("\n", 1)[0].strip()
            what = "a quote that ends" if text[at] == '"' else "a comment that ends"
            raise InputError(where, rest, what)
        kind = match.lastgroup or ""
        if kind == "template":
            hint = "Make the configuration from its templates first"
            raise InputError(
                where, text[at:].split("\n", 1)[0].strip(), "a configuration, not a template", hint
            )
        if kind == "string" and SWALLOWED.search(match[kind]):
            raise InputError(
                where, text[at:].split("\n", 1)[0].strip(), "a quote that ends before the next attribute"
            )
        if kind not in ("space", "comment"):
            yield kind, match[kind], line
        line += match[0].count("\n")
        at = match.end()


def written(blocks: Sequence[Block], remarks: Sequence[str] = ()) -> str:
    """The text of a configuration; lists go over several lines as they do there."""
    out = [f"// {remark}" for remark in remarks]
    for block in blocks:
        out += ["", f"  {f'{block.kind}:':<{HEAD_WIDTH - 2}}  {block.name}"]
        for attribute in block.attributes:
            values = [f'"{v}"' if isinstance(v, Text) else v for v in attribute.values]
            rows = ["    ".join(values[k : k + PER_LINE + 1]) for k in range(0, len(values), PER_LINE + 1)]
            out.append(f"{attribute.name:>{KEY_WIDTH}}=  {rows[0] if rows else ''}".rstrip())
            out += [" " * (KEY_WIDTH + 3) + row for row in rows[1:]]
    return "\n".join(out).lstrip("\n") + "\n"
