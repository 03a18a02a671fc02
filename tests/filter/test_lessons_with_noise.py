"""A lesson may bring a path whose effects add noise of their own, or take them away, while the filter runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import edgefilter
from edgefilter import EgoFilter, Profile
from edgefilter.echo.effects.catalogue import EFFECTS
from edgefilter.filter.echo_path import EchoPath, FilteredHop, Lesson, PathState

DEMO = Path(edgefilter.__file__).parent / "demo_data"
NOISY = next(effect for effect in EFFECTS if effect.noise_is_asked)
WITH = ((NOISY.name, {p.name: (p.neutral + p.high) / 2 for p in NOISY.told}),)


class Teacher:
    """Hands over the path that it was given at the start, with other effects, after some hops."""

    def __init__(self, effects):
        self.effects, self.hops = effects, 0

    def start(self, path: PathState, hop: int) -> None:
        self.path = path

    def observe(self, hop: FilteredHop) -> Lesson | None:
        self.hops += 1
        return (
            Lesson(PathState(self.effects, self.path.canceller), "learned", "another path") if self.hops == 30 else None
        )

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
    ego = EgoFilter(profile.with_echo(echo), "ss", learn=Teacher(after))
    mic, ref = (0.1 * np.random.default_rng(0).standard_normal((2, 16_000))).astype(np.float32)
    out = np.concatenate((ego.process(mic, ref), ego.flush()))
    assert np.isfinite(out).all() and [event.kind for event in ego.events()].count("learned") == 1
    path = ego._stream.front.linear_stage.path
    assert isinstance(path, EchoPath) and path.effects == after and bool(path.source.colours) == bool(after)
    assert bool(ego._stream.front._unpredictable) == bool(after)
