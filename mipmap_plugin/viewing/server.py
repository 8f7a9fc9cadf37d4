"""viser's server (extra `view`), at an address that can be served."""

from __future__ import annotations

import contextlib
import errno
import io
import socket
from typing import Any

from mipmap_plugin.errors import SettingsError, install

NO_VISER = f"the live view needs viser; {install('view')}"


def served(host: str, port: int) -> Any:
    """viser's server at the first free port from `port` on. Raises SettingsError."""
    try:
        import viser
    except ImportError as error:
        raise SettingsError(NO_VISER) from error
    check_address(host, port)
    with without_words():
        return viser.ViserServer(host=host, port=port, verbose=False)


def without_words() -> contextlib.AbstractContextManager[Any]:
    """viser prints that it starts and stops, quiet or not; what is to be said is said by the command."""
    return contextlib.redirect_stdout(io.StringIO())


def check_address(host: str, port: int) -> None:
    """Raise SettingsError for an address that cannot be served; viser itself would wait forever. A port that is taken is no such thing."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except (OSError, OverflowError, UnicodeError) as error:
        if getattr(error, "errno", None) != errno.EADDRINUSE:
            raise SettingsError(f"nothing can be served at {host}, port {port} ({error}); give --host 127.0.0.1 and a --port above 1023") from error
