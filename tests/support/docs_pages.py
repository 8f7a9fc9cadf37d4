"""What README.md and docs/ hold: their blocks, and what is between backticks."""

import inspect
import re
from dataclasses import dataclass
from pathlib import Path

from mipmap_plugin import cli
from mipmap_plugin.commands.adapt import Changes
from mipmap_plugin.commands.many import Many

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]

FENCE = re.compile(r"^```(\S*)[^\n]*\n(.*?)^```$", re.DOTALL | re.MULTILINE)
SPAN = re.compile(r"`([^`\n]+)`")
SNIPPET = re.compile(r'^--8<-- "([^":]+)(?::(\w+))?"$', re.MULTILINE)

COMMANDS = cli.COMMANDS


@dataclass(frozen=True)
class Piece:
    """Something between backticks."""

    page: Path
    text: str

    def __str__(self) -> str:
        return f"{self.page.name}: {self.text.strip().splitlines()[-1]}"


def prose(page: Path) -> str:
    """What is outside of all blocks."""
    return FENCE.sub("", page.read_text(encoding="utf-8"))


def blocks(page: Path, *, python: bool) -> list[str]:
    return [text for language, text in FENCE.findall(page.read_text(encoding="utf-8")) if (language == "python") == python]


def shell_pieces(page: Path) -> list[Piece]:
    """Each command of a block, and each piece of code within a sentence or a table."""
    lines = [line for block in blocks(page, python=False) for line in block.splitlines()]
    return [Piece(page, part.strip()) for text in (*lines, *SPAN.findall(prose(page))) for part in text.split("&&") if part.strip()]


SHELL = [piece for page in PAGES for piece in shell_pieces(page)]
CALLS = list({piece.text: piece for piece in SHELL if piece.text.startswith("mipmap-plugin ")}.values())
PYTHON = [Piece(page, block) for page in PAGES for block in blocks(page, python=True) if not SNIPPET.search(block)]


def is_mention(words: list[str]) -> bool:
    """`mipmap-plugin adapt` alone is the name of a command, and nothing that is run."""
    return len(words) == 1 and words[0] in COMMANDS


def options(command: str) -> set[str]:
    """The names of a command's options, as Python writes them; those of `adapt` are partly in groups."""
    names = set(inspect.signature(COMMANDS[command]).parameters)
    return names.union(*(vars(group) for name, group in {"changes": Changes(), "many": Many()}.items() if name in names))
