"""Why a run ends, and how reports tell it."""

from __future__ import annotations

from enum import Enum

from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import plural


class End(Enum):
    """Why a run takes no further step. States of runs hold the values."""

    STEPS = "steps"
    TIME = "time budget"
    START = "time budget, all of which the start took"
    CHOICE = "time budget, all of which the start and the choice of a state take"
    ALIKE = "start, which looks like the pseudo truth"
    STUCK = "no gain"
    TARGET = "target"
    KNEE = "knee"
    OBSERVER = "its observer"

    def told(self, config: AdaptConfig, steps: int, share: float = 1.0) -> str:
        """In words, of a run of so many steps. `share`: of the time budget that was asked for, which `config` has; a conversion had the rest."""
        budget = f"time budget of {(config.time_budget_s or 0.0) / share:g} s"
        match self:
            case End.STEPS:
                return plural(steps, "step")
            case End.TIME:
                return budget
            case End.START:
                return f"{budget}, all of which {'the start' if share == 1 else 'the conversion and the start'} took"
            case End.CHOICE:
                start = "the start" if share == 1 else "the conversion, the start"
                return f"{budget}, not enough for a step beside {start} and the choice of a state"
            case End.ALIKE:
                return "the start, which differs from the pseudo truth by less than a display shows"
            case End.STUCK:
                return f"{plural(steps, 'step')}, which gained nothing at rates that do no harm"
            case End.TARGET:
                return f"target of {config.target_db:g} dB against the pseudo truth"
            case End.KNEE:
                return f"knee: {plural(config.patience or 0, 'check')} in a row gained less than {config.min_gain_db:g} dB"
            case End.OBSERVER:
                return str(self.value)
