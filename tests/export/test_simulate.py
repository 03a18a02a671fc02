"""The training simulator: reproducible items whose parts are what they claim to be."""

from dataclasses import replace

import numpy as np
import pytest

from edgefilter.errors import UsageError
from export.corpus import read_corpus
from export.rooms import draw_room
from export.simulate import PAPER, RECIPES, draw_colour, simulate
from tests.export.speech import RATE, write_librispeech, write_table


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    folder = tmp_path_factory.mktemp("speech")
    humans = read_corpus(write_librispeech(folder / "humans", ("11", "12", "13")))
    robots = read_corpus(write_table(folder / "robots", ("a", "b")))
    return humans, robots, [draw_room(np.random.default_rng(kind == "lab"), kind) for kind in ("lab", "office")]


def test_an_item_depends_on_seed_and_index_alone(parts):
    first, again = (simulate(RECIPES["edge"], 3, 5, *parts) for _ in range(2))
    other = simulate(RECIPES["edge"], 3, 6, *parts)
    assert np.array_equal(first.mic, again.mic) and first.about == again.about
    assert not np.array_equal(first.mic, other.mic)


def test_the_papers_recipe_has_the_papers_segments(parts):
    for index in range(6):
        item = simulate(PAPER, 1, index, *parts)
        assert item.mic.size == item.clean.size == item.reference.size == 5 * RATE
        onset = int(np.argmax(np.abs(item.clean) > 1e-4 * np.abs(item.clean).max()))
        assert 0.5 * RATE <= onset < 1.6 * RATE  # 0.5 to 1.5 s, and the way through the room
        robot = item.mic - item.clean
        assert np.mean(robot**2) > 30 * np.mean(item.clean**2)


def test_the_human_is_inside_the_microphone(parts):
    item = simulate(replace(RECIPES["edge"], human=1.0, warm=1.0), 2, 0, *parts)
    assert item.profile is not None and np.any(item.clean)
    silent = simulate(replace(RECIPES["edge"], human=0.0), 2, 0, *parts)
    assert not np.any(silent.clean)


def test_effects_of_a_profile_change_the_robot(parts):
    plain = replace(RECIPES["edge"], moving=0.0, effects_share=1.0)
    turned_down = replace(plain, effects=(("bandlimit", {"cutoff_hz": 1500.0, "order": 4.0}),))
    items = [simulate(recipe, 4, 1, *parts) for recipe in (plain, turned_down)]
    high = [np.sum(np.abs(np.fft.rfft(item.mic - item.clean))[-item.mic.size // 8 :] ** 2) for item in items]
    assert high[1] < 0.5 * high[0]
    assert items[1].about["effects"] == ["bandlimit"]


def test_rooms_decay_as_long_as_asked():
    room = draw_room(np.random.default_rng(3), "office")
    energy = np.cumsum(room.humans[0][::-1].astype(float) ** 2)[::-1]
    decay = 10 * np.log10(energy / energy[0])
    fall = (np.argmax(decay < -35) - np.argmax(decay < -5)) / RATE * 2
    assert 0.5 * room.rt60_s < fall < 2.0 * room.rt60_s  # Sabine's formula is that coarse in small rooms


def test_a_folder_without_speech_is_named(tmp_path):
    with pytest.raises(UsageError, match="holds no speech"):
        read_corpus(tmp_path)


def test_the_robots_colour_is_always_stable():
    for seed in range(300):
        colour = draw_colour(np.random.default_rng(seed))
        assert np.isfinite(colour).all() and np.abs(colour[-100:]).max() < 0.1 * np.abs(colour).max()
