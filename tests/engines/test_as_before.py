"""What each engine makes of the demonstration, and several that take turns: as it was before."""

import numpy as np
import pytest

from edgefilter import EgoFilter, Profile
from edgefilter.engines import create
from edgefilter.engines.combined import Fallback, fallbacks, with_network_as_judge
from edgefilter.filter.budget import DEMO
from edgefilter.filter.stream import Stream
from tests import program
from tests.as_before import levels_db, same_as_before


def demo() -> tuple[np.ndarray, np.ndarray, Profile]:
    return *(x[: 10 * 16000] for x in program.demo("mic", "reference")), Profile.load(DEMO / "profile.npz")


@pytest.mark.parametrize("engine", ["paper-ss", "ss", "crnn"])
def test_alone(engine: str) -> None:
    mic, ref, profile = demo()
    ego, out, probability = EgoFilter(profile, engine=engine), [], []
    for at in range(0, ref.size, 2000):
        out.append(ego.process(mic[at : at + 2000], ref[at : at + 2000]))
        probability.append(ego.speech_probability)
    out.append(ego.flush())
    same_as_before(f"engine_{engine}", {"out": levels_db(np.concatenate(out), 0.125), "probability": probability}, 0.05)


def test_with_another_lag() -> None:
    """The paper's alignment has to find where the reference is."""
    mic, ref, profile = demo()
    ego = EgoFilter(profile, engine="paper-ss")
    out = np.concatenate((ego.process(mic, np.pad(ref, (3000, 0))[: ref.size]), ego.flush()))
    same_as_before("engine_paper-ss_later", {"out": levels_db(out), "alignment": ego.stats()["alignment"]}, 0.05)


def test_with_the_network_as_judge() -> None:
    mic, ref, profile = demo()
    stream, probability = Stream(with_network_as_judge(create("ss", profile), profile), profile), []
    for at in range(0, ref.size, 2000):
        stream.process(mic[at : at + 2000], ref[at : at + 2000])
        probability.append(stream.speech_probability)
    same_as_before("engine_judged", {"probability": probability}, 0.05)


def test_in_turn() -> None:
    """From the best to the cheapest, back, and back again before the crossfade has ended."""
    mic, ref, profile = demo()
    fallback = Fallback(fallbacks(create("crnn", profile), profile))
    last = len(fallback.engines) - 1
    wanted = {40: last, 80: 0, 130: last, 132: 0, 160: 1, 170: last}
    hop, out = fallback.stft.hop, []
    stream = Stream(fallback, profile)
    for count, at in enumerate(range(0, ref.size, hop)):
        fallback.wanted = wanted.get(count, fallback.wanted)
        out.append(stream.process(mic[at : at + hop], ref[at : at + hop]))
    same_as_before("engines_in_turn", {"out": levels_db(np.concatenate(out), hop / 16000)[:220]}, 0.05)
