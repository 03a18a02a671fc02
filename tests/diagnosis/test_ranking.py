"""Which of several effects is named first: the one that is missed most when the others are fitted anew without it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.select import _in_steps
from edgefilter.diagnosis.trials import Workbench, less
from edgefilter.echo.model import EchoModel

START = EchoModel(np.eye(1, 8, dtype=np.float32)[0])
GAIN, BENT = "playback_gain", "speaker_nonlinearity"
BOTH = START.with_effect(GAIN, {"gain_db": 2.0}).with_effect(BENT, {"odd": -0.2})


class Bench:
    """A workbench on which each model leaves what `joint` says of its effects' values, and `anew` of one fitted by itself."""

    def __init__(self, joint: dict[tuple[str, ...], float], anew: dict[str, float]) -> None:
        self.joint, self.anew = joint, anew

    def score(self, model: EchoModel) -> SimpleNamespace:
        left = self.joint[tuple(sorted(name for name, _ in model.effects))]
        return SimpleNamespace(level_db=left, excess_db=left)

    def attempt(self, name: str, model: EchoModel) -> SimpleNamespace:
        assert model is START
        return SimpleNamespace(score=SimpleNamespace(level_db=self.anew[name]))

    def less(self, model: EchoModel, name: str) -> EchoModel:
        return less(START, model, name)

    def beside(self, name: str, others: EchoModel, model: EchoModel) -> SimpleNamespace:
        return SimpleNamespace(name=name, score=self.score(model))


@pytest.mark.parametrize(
    ("bent_db", "anew", "first"),
    [
        (9.0, {GAIN: 4.0, BENT: 1.0}, BENT),  # an overdrive: a bent amplifier does nearly all of it by itself
        (9.0, {GAIN: 1.0, BENT: 8.0}, GAIN),
        (12.0, {GAIN: 4.0, BENT: 1.0}, GAIN),  # beside no gain its own values are worse than none: told the other way
    ],
)
def test_what_a_bent_amplifier_raises_is_not_the_volumes(bent_db: float, anew: dict[str, float], first: str) -> None:
    bench = Bench({(): 10.0, (GAIN,): 3.0, (BENT,): bent_db, (GAIN, BENT): 0.5}, anew)
    steps = _in_steps(bench, START, BOTH)  # type: ignore[arg-type]  # as much of a Workbench as is asked
    assert [step.name for step in steps] == [first, BENT if first is GAIN else GAIN]
    assert steps[-1].score.excess_db == 0.5


def test_one_effect_outdoes_another_by_its_own_chance_and_not_by_that_of_all() -> None:
    # a hard clip ahead of the loudspeaker: the limiter leaves 2.0 dB, the loudspeaker's curve 0.7
    clipped = [SimpleNamespace(name="limiter", gain_db=0.48), SimpleNamespace(name=BENT, gain_db=0.83)]
    bench = SimpleNamespace(criteria=Criteria())
    bench._outdoes = lambda one, other: Workbench._outdoes(bench, one, other)
    assert Workbench.preferred(bench, clipped).name == BENT
    clipped[1].gain_db = 0.55  # more by what ordinary recordings show
    assert Workbench.preferred(bench, clipped).name == "limiter"
