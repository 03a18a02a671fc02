"""A update may bring a path whose effects add noise of their own, or take them away, while the filter runs."""

from __future__ import annotations

import numpy as np
import pytest

from edgefilter import Profile
from edgefilter.echo.effects.catalogue import find
from edgefilter.engines.spectral_subtraction import SpectralSubtraction
from edgefilter.filter.echo_path import FilteredHop, PathState, PathUpdate
from edgefilter.filter.stream import Stream
from tests.program import DEMO

MIDDLE = {one.name: (one.neutral + one.high) / 2 for one in find("rattle").told}
WITH = (("rattle", {**MIDDLE, "threshold": 0.1, "outward": 0.0, "inward": 0.0}),)


class Listening(SpectralSubtraction):
    """Notes what power of the residual echo it is told in each hop."""

    def __init__(self):
        super().__init__()
        self.told = []

    def step(self, frame, state):
        self.told.append(frame.residual_psd.mean())
        return super().step(frame, state)


class Teacher:
    """Hands over the path that it was given at the start, with other effects, after some hops."""

    def __init__(self, effects):
        self.effects, self.hops = effects, 0

    def start(self, path: PathState, hop: int) -> None:
        self.path = path

    def observe(self, hop: FilteredHop) -> PathUpdate | None:
        self.hops += 1
        path = PathState(self.effects, self.path.canceller)
        return PathUpdate(path, "learned", "another path") if self.hops == 30 else None

    def stats(self):
        return {}

    def close(self) -> None:
        pass


@pytest.mark.parametrize(("before", "after"), [(WITH, ()), ((), WITH)], ids=["taken away", "brought"])
def test_what_no_waveform_predicts_follows_the_path_in_use(before, after):
    """Found by random damage: an effect that learning took away ended the run."""
    profile = Profile.load(DEMO / "profile.npz")
    echo = profile.echo
    for name, values in before:
        echo = echo.with_effect(name, values)
    engine = Listening()
    stream = Stream(engine, profile.with_echo(echo), learner=Teacher(after))
    mic, ref = (0.1 * np.random.default_rng(0).standard_normal((2, 16_000))).astype(np.float32)
    mic = (0.01 * mic + np.pad(profile.echo.predict(ref), (100, 0))[: ref.size]).astype(np.float32)
    out = np.concatenate((stream.process(mic, ref), stream.flush()))
    assert np.isfinite(out).all() and [event.kind for event in stream.events].count("learned") == 1
    early, late = np.mean(engine.told[10:28]), np.mean(engine.told[40:58])  # the update comes with hop 30
    assert late > 1e3 * early if after else early > 1e3 * late
