"""Pictures of a terminal in which `demo` and `inspect` ran, for the docs.

    python benchmarks/terminal_pictures.py

Runs both on the embedded scene and writes docs/demo.svg and docs/inspect.svg.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from pathlib import Path

from rich.console import Console
from rich.text import Text

import mipmap_plugin

DOCS, DEMO = Path(__file__).parents[1] / "docs", Path(mipmap_plugin.__file__).parent / "demo"

# Characters: as wide as the longest line of the demo.
WIDTH = 132


def main() -> None:
    """Run the commands and draw what they print."""
    with tempfile.TemporaryDirectory() as folder:
        for name, shown in (("base.ply", "bicycle.ply"), ("cameras.json", "cameras.json")):
            (Path(folder) / shown).write_bytes((DEMO / name).read_bytes())
        for name, words in (("demo", ["demo"]), ("inspect", ["inspect", "bicycle.ply"])):
            done = subprocess.run(["mipmap-plugin", *words], cwd=folder, capture_output=True, text=True, check=True)
            draw(DOCS / f"{name}.svg", "mipmap-plugin " + " ".join(words), done.stdout)


def draw(picture: Path, command: str, printed: str) -> None:
    """Draw a terminal with a command and what it printed."""
    with open("/dev/null", "w") as nowhere:
        console = Console(record=True, width=WIDTH, file=nowhere)
        console.print(Text(f"$ {command}", style="bold"))
        console.print(Text(printed.rstrip()))
        svg = console.export_svg(title="")
    # Without the fonts that rich would load from the network: the reader's own monospace serves.
    svg = re.sub(r"@font-face \{.*?\}\s*", "", svg, flags=re.S)
    picture.write_text(re.sub(r"[ \t]+$", "", svg, flags=re.M), encoding="utf-8")
    print(f"wrote {picture}")


if __name__ == "__main__":
    main()
