"""What the filter makes of the demonstration and of rooms in which much happens, quarter second by quarter second: as it was before."""

import numpy as np
import pytest

from edgefilter import EgoFilter, Profile
from edgefilter.filter.budget import DEMO
from tests.as_before import levels_db, same_as_before
from tests.filter.array_scene import calibration, talk
from tests.learning.scenes import Scene
from tests.program import demo

UNTIMED = ("engine", "engine_reason", "engines", "alignment", "linear_stage", "array", "samples")


def told(ego: EgoFilter, mic: np.ndarray, ref: np.ndarray) -> dict:
    """Levels of what comes out, the human's probability, in tenths, and the events as they come, and the figures at the end."""
    out, probability = [], []
    for at in range(0, ref.size, 4000):
        out.append(ego.process(mic[at : at + 4000], ref[at : at + 4000]))
        probability.append(10.0 * (ego.speech_probability or 0.0))
    out.append(ego.flush())
    stats = ego.stats()
    return {
        "out": levels_db(np.concatenate(out)),
        "probability": probability,
        "events": [
            (one.kind, one.sample, one.detail) for one in ego.events() if one.kind != "overloaded"
        ],  # the machine's
        "stats": {name: stats[name] for name in UNTIMED},
    }


@pytest.mark.parametrize(
    ("engine", "knows"), [("linear", True), ("ss", True), ("crnn", True), ("linear", False), ("crnn", False)]
)
def test_of_the_demonstration(engine: str, knows: bool) -> None:
    mic, ref = demo("mic", "reference")
    profile = Profile.load(DEMO / "profile.npz") if knows else None
    found = told(EgoFilter(profile, engine=engine), mic, ref)
    same_as_before(f"filter_demo_{engine}_{'known' if knows else 'unknown'}", found, 0.1, 1e-3)


SCENES = {
    "volume": {"volume": 0.3},
    "louder": {"volume": 3.0, "human_db": -12.0},
    "moved": {"moved": 9},
    "lag": {"lag": 700, "ppm": 60.0},
    "repeats": {"human_db": -3.0, "repeats": True},
    "whisper": {"volume": 0.02},
    "shout": {"volume": 30.0, "human_db": -20.0},
}
"""What happens in the middle of each, as Scene has it."""


@pytest.mark.parametrize("what", SCENES)
def test_of_a_robot_to_which_something_happens(what: str) -> None:
    scene = Scene(8.0, **SCENES[what])
    same_as_before(f"filter_{what}", told(EgoFilter(engine="crnn"), scene.mic, scene.reference), 0.3, 1e-3)


REFERENCES = {
    "late": lambda x: np.pad(x, (8000, 0))[: x.size],
    "another": lambda x: np.roll(x[::-1], 5000),
    "silent": np.zeros_like,
    "cut": lambda x: np.where(np.arange(x.size) % 24_000 < 12_000, x, 0.0).astype(np.float32),
    "louder": lambda x: np.clip(20.0 * x, -1.0, 1.0),
}
"""What is handed over for what the robot said."""


@pytest.mark.parametrize("what", REFERENCES)
def test_of_a_reference_that_is_wrong(what: str) -> None:
    scene = Scene(12.0, human_db=-6.0)
    reference = REFERENCES[what](scene.reference)
    same_as_before(f"filter_reference_{what}", told(EgoFilter(engine="linear"), scene.mic, reference), 0.3, 1e-3)


def test_of_an_array_with_a_microphone_that_breaks() -> None:
    mics, ref, _ = talk()
    mics = mics.copy()
    mics[mics.shape[0] // 2 :, 2] = 0.0
    same_as_before("filter_array", told(EgoFilter(calibration(3), engine="crnn"), mics, ref), 0.3, 1e-3)
