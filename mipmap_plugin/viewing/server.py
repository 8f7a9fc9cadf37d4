"""viser's server (extra `view`), at an address that can be served."""

from __future__ import annotations

import contextlib
import errno
import io
import socket
import warnings
from collections.abc import Iterator, Mapping
from http import HTTPStatus
from importlib import import_module
from typing import Any

from mipmap_plugin.errors import SettingsError, install, warn

# Said on the terminal, because the page itself only waits: the page may be the right one behind a proxy.
FOREIGN = "a page of {origin} asked for this one's pictures, and got none; if it is this one behind a proxy, let it pass on Host or X-Forwarded-Host"

# viser warns, in our name, of a picture for a browser that was closed while it was drawn.
CLOSED = "Queued a .* on a closed connection"

NO_VISER = f"the live view needs viser; {install('view')}"


def served(host: str, port: int) -> Any:
    """viser's server at the first free port from `port` on. Raises SettingsError."""
    try:
        import viser
    except ImportError as error:
        raise SettingsError(NO_VISER) from error
    check_address(host, port)
    warnings.filterwarnings("ignore", message=CLOSED)
    with without_words(), _own_pages_only():
        return viser.ViserServer(host=host, port=port, verbose=False)


@contextlib.contextmanager
def _own_pages_only() -> Iterator[None]:
    """Let what viser serves inside the block refuse connections of other web pages, for which viser has no setting.

    A browser lets every page connect to this machine, so that a foreign one could see the scene, adapt and save.
    """
    server: Any = import_module("websockets.asyncio.server")  # an extra's, whose types mypy may lack
    serve = server.serve

    def guarded(*args: Any, process_request: Any, **options: Any) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            if not foreign_page(request.headers):
                return process_request(connection, request)
            warn(FOREIGN.format(origin=ascii(request.headers["Origin"])))  # ours, as the command hides others
            return connection.respond(HTTPStatus.FORBIDDEN, "this page is not that of the live view\n")

        return serve(*args, process_request=answer, **options)

    server.serve = guarded
    try:
        yield
    finally:
        server.serve = serve


def foreign_page(headers: Mapping[str, str]) -> bool:
    """Whether a browser asks for a connection on behalf of another page. Only browsers name one, and proxies may name the hosts asked for."""
    page = headers.get("Origin")
    hosts = [host for name in ("Host", "X-Forwarded-Host") for each in headers.get(name, "").split(",") if (host := each.strip())]
    return page is not None and headers.get("Upgrade") is not None and page.partition("://")[2] not in hosts


def without_words() -> contextlib.AbstractContextManager[Any]:
    """Discard what viser prints when it starts and stops, for it does so even if told to be quiet."""
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
