"""A robot that can be asked does to any sound what it did to its recording; what it says is counted by odds."""

from __future__ import annotations

import numpy as np
import pytest

from bench.diagnosis import probe
from bench.diagnosis.probe import Row
from bench.simulate.asked_robot import CHANGES, AskedRobot
from bench.simulate.hidden_robot import Scene, decibels, draw_scene, power
from tests.bench.conftest import RATE, babble


@pytest.fixture(scope="module")
def scene() -> Scene:
    x = np.pad(1.6 * babble(5.0, 1).astype(float), (RATE // 2, RATE // 2))
    return draw_scene(np.random.default_rng(3), x, 26.0)


@pytest.mark.parametrize("truth", CHANGES)
def test_asked_for_what_it_said_it_says_the_same_again(scene: Scene, truth: str) -> None:
    """Its voice is the same but for the fan; a codec's last frame knows what follows, so the end is left out."""
    chain, player = CHANGES[truth](np.random.default_rng(4), scene, "clear")
    robot = AskedRobot(truth, (), scene.reference, scene.record(chain), scene.reference, scene, chain, player, 0.5)
    again, noise = robot.ask(scene.reference, 5), 0.5 * chain.fan
    assert again.size == scene.reference.size + RATE and again.dtype == np.float32
    left = 0.5 * robot.recording - again[: scene.reference.size]
    assert decibels(power(left[: -RATE // 2]) / power(noise)) == pytest.approx(3.0, abs=1.5)  # two fans
    assert decibels(power(again[-RATE // 2 :]) / power(noise)) == pytest.approx(0.0, abs=2.0)  # silence after it
    changed = scene.over_fan_db(scene.record(chain) - chain.fan - scene.echo(scene.usual))
    assert truth in ("fan_noise", "mic_clipping") or changed > 5.0


@pytest.mark.parametrize(
    ("likely", "said"),
    [
        ((0.99, 0.01, 0.0), "right"),
        ((0.9524, 0.0476, 0.0), "right"),
        ((0.95, 0.05, 0.0), "open"),
        ((0.01, 0.99, 0.0), "wrong"),
        ((0.01, 0.01, 0.98), "open"),  # none of them
    ],
)
def test_what_is_settled_needs_odds_of_twenty_to_one(likely: tuple[float, ...], said: str) -> None:
    assert probe.outcome(np.array(likely), 0) == said


def test_robots_are_counted_by_way_by_pair_and_where_the_recording_does_not_settle_it() -> None:
    pair, right = probe.PAIRS[0], "right"
    rows = [
        Row(pair, pair[0], "near", (right, right, right, right, right), ("noise",)),
        Row(pair, pair[1], "near", ("open", "wrong", "open", "wrong", "open"), ("noise", "odd lines")),
        Row(probe.PAIRS[1], "codec", "near", ("wrong", "open", right, right, right), ("noise",)),
    ]
    counts, pairs, sounds = probe.tables(rows)
    assert [row[0] for row in counts["rows"]] == list(probe.WAYS)
    assert [row[1].split(" [")[0] for row in counts["rows"]] == ["1 of 3", "1 of 3", "2 of 3", "2 of 3", "2 of 3"]
    assert [row[2:4] for row in counts["rows"]] == [[1, 1], [1, 1], [1, 0], [0, 1], [1, 0]]
    assert counts["rows"][0][4:] == [None] * 3
    assert [row[4].split(" [")[0] for row in counts["rows"][1:]] == ["0 of 2", "1 of 2", "1 of 2", "1 of 2"]
    assert [row[0] for row in pairs["rows"]] == ["playback_gain or compression", "fan_noise or codec"]
    assert sounds["rows"] == [["noise", 3], ["odd lines", 1]]
