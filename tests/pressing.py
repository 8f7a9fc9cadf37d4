"""What interrupts a run in the middle of a step."""

from mipmap_plugin.adaptation.optimization import loop


def in_step(monkeypatch, act):
    """Returned is what, called with n, has `act` called in the nth step from then on, whatever the backend."""
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
