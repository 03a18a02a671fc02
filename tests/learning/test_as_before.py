"""What is learned of a distorting loudspeaker, and remembered: as it was before."""

import numpy as np
import pytest

from edgefilter import EgoFilter, PathLearner, Profile, self_calibrate
from tests.as_before import levels_db, same_as_before
from tests.learning.scenes import Scene

SCENES = {"alone": {}, "moved": {"moved": 9}, "human": {"human_db": -6.0}, "elsewhere": {}}
"""The last with a profile of another room."""


@pytest.mark.parametrize("what", SCENES)
def test_of_a_loudspeaker(what: str, tmp_path) -> None:
    scene = Scene(16.0, **SCENES[what])
    file = tmp_path / "robot.npz"
    learner = PathLearner(remember=file)
    before = Scene(8.0, moved=4).part(4.0, 8.0)
    profile = self_calibrate(before.mic, before.reference) if what == "elsewhere" else None
    with EgoFilter(profile, engine="linear", learn=learner) as ego:
        out = ego.process(scene.mic, scene.reference)
        events = [(one.kind, one.sample, one.detail) for one in ego.events()]
    known = Profile.load(file) if file.exists() else None
    found = {"out": levels_db(out), "events": events, "stats": learner.stats()}
    if known:
        response = known.echo.impulse_response
        found["remembered"] = {
            "effects": known.echo.effects,
            "path": [float(np.sum(part**2)) for part in np.array_split(response, 40)],
            "fan": known.noise_psd[::20] * 1e8,
            "bands": known.band_snr_db,
        }
    same_as_before(f"learning_{what}", found)
