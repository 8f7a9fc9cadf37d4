"""`mipmap-plugin backends`."""

from __future__ import annotations

from dataclasses import asdict

from mipmap_plugin.commands.common import tell
from mipmap_plugin.errors import SettingsError


def backends(check: str | None = None, full: bool = False, json: bool = False) -> None:
    """List the backends and what each lacks for this machine's usual work, or check one against the reference.

    Args:
        check: Run the conformance suite on this backend and print a table; a minute on a usual processor.
        full: Check it on hundreds of random scenes too; several minutes.
        json: Print JSON.
    """
    from mipmap_plugin.evaluation import backends as shown

    if full and check is None:
        raise SettingsError("--full says how much to check; say what, with --check NAME")
    if check is None:
        listed = shown.listing()
        print(shown.listing_table(listed)) if not json else tell([asdict(row) for row in listed], json)
        return
    outcomes = shown.check(check, full=full)
    print(shown.check_table(outcomes)) if not json else tell([asdict(row) for row in outcomes], json)
    failed = [row.case for row in outcomes if not row.passed]
    if failed:
        raise SettingsError(f"backend {check!r} fails {len(failed)} of {len(outcomes)} cases: {', '.join(failed[:5])}")
