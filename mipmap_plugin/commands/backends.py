"""`mipmap-plugin backends`."""

from __future__ import annotations

from dataclasses import asdict

from mipmap_plugin.commands.common import print_json, starting
from mipmap_plugin.commands.list import warn_of_other_groups
from mipmap_plugin.commands.voice import say
from mipmap_plugin.errors import SettingsError

# Failed cases that the last line names; the table has all of them at its end.
NAMED = 5


def backends(check: str | None = None, full: bool = False, json: bool = False) -> None:
    """List the backends and why each can or cannot adapt on this machine, or check one against the reference.

    Args:
        check: Run the conformance suite on the backend of this name (a minute). Exit code 2 if a case fails, or if hardly any can be run.
        full: With --check: also run hundreds of random scenes; several minutes.
        json: Print JSON.
    """
    with starting():
        from mipmap_plugin.backends.conformance import LEAST_RUN, summary
        from mipmap_plugin.evaluation import backends as tables

    if full and check is None:
        raise SettingsError("--full needs a backend to check; give --check NAME")
    warn_of_other_groups()
    if check is None:
        rows = tables.listing()
        return print_json([asdict(row) for row in rows]) if json else say(tables.listing_table(rows))
    outcomes = tables.check(check, full=full)
    if json:
        print_json([asdict(row) for row in outcomes])
    else:
        say(f"{tables.check_table(outcomes)}\n{summary(outcomes)}")
    failed = [row.case for row in outcomes if not row.passed]
    if failed:
        more = f" and {len(failed) - NAMED} more" if len(failed) > NAMED else ""
        likely = f"; most likely {fault}" if (fault := tables.likely_fault(check)) else ""
        raise SettingsError(f"backend {check!r} fails {len(failed)} of {len(outcomes)} cases: {', '.join(failed[:NAMED])}{more}{likely}")
    skipped = [row.message for row in outcomes if row.skipped]
    if len(outcomes) - len(skipped) < LEAST_RUN * len(outcomes):
        few = f"{len(outcomes) - len(skipped)} of {len(outcomes)} cases"
        raise SettingsError(f"backend {check!r} passes {few}, too few to tell whether it is right; of the others it says: {skipped[0]}")
