"""The file that `--log` names: a line for each thing that is said, with the time of day."""

from __future__ import annotations

import contextlib
import re
import sys
from datetime import datetime
from pathlib import Path
from typing import TextIO

from mipmap_plugin.errors import OutputError
from mipmap_plugin.formats.nodes import refuse_named_pipe

# How every line begins: by it a file is known to be a log, and not one that was named by mistake, such as a checkpoint.
BEGINNING = re.compile(rb"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d ")


class Log:
    """A file that is appended to. Once it cannot be written, that is said, and the command goes on without."""

    def __init__(self, path: Path) -> None:
        """Open it. Raises OutputError for a file that cannot be written, or that holds something else."""
        self._path = path
        self._file: TextIO | None
        try:
            refuse_named_pipe(path)
            self._file = path.open("a", encoding="utf-8", errors="backslashreplace") if _may_be_a_log(path) else None
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise OutputError(f"{path} cannot be written ({reason}); give --log another file") from error
        if self._file is None:
            raise OutputError(f"{path} holds something else than a log; give --log another file")

    def write(self, text: str) -> None:
        """Append the lines of a text."""
        if self._file is None:
            return
        now = datetime.now().isoformat(sep=" ", timespec="seconds")
        try:
            self._file.writelines(f"{now} {line}\n" for line in text.splitlines())
            self._file.flush()  # a killed run leaves all that it said
        except OSError as error:
            self.close()
            print(f"mipmap-plugin: {self._path} cannot be written ({error.strerror}), so the log ends here", file=sys.stderr)

    def close(self) -> None:
        """Close the file; what is written later is lost."""
        if self._file is not None:
            with contextlib.suppress(OSError):  # the disk is full, which was said
                self._file.close()
            self._file = None


def _may_be_a_log(path: Path) -> bool:
    """Whether a path is new, an empty file, a log, or a device."""
    if not path.is_file():
        return True
    with path.open("rb") as file:
        line = file.read(20)
    return not line or BEGINNING.match(line) is not None
