"""What interrupts a run while it takes a step."""

from mipmap_plugin.adaptation.optimization import loop


def in_step(monkeypatch, act):
    """Return a function: called with n, it has `act` called as the nth step from then on begins, whatever the backend."""
    step, waiting = loop._step, []

    def interrupted(*arguments):
        if waiting:
            waiting[0] -= 1
            if waiting[0] == 0:
                waiting.clear()
                act()
        step(*arguments)

    monkeypatch.setattr(loop, "_step", interrupted)
    return waiting.append
