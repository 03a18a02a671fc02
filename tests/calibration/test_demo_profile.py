"""The profile that the package brings is what its recordings give."""

from pathlib import Path

import numpy as np
import pytest
import soundfile

import edgefilter
from edgefilter import Profile, calibrate
from tests.program import CALIBRATION


def test_the_bundled_profile_is_what_calibration_makes_of_its_recordings():
    names = ("sweep_reference", "sweep_recording", "fan")
    made = calibrate(*(soundfile.read(CALIBRATION / f"{name}.flac", dtype="float32")[0] for name in names))
    kept = Profile.load(Path(edgefilter.__file__).parent / "demo_data/profile.npz")
    assert made.delay == kept.delay and made.warnings == kept.warnings
    path = kept.echo.impulse_response
    # 1e-4 of the direct sound: other versions of numpy and scipy round differently in the deconvolution
    np.testing.assert_allclose(made.echo.impulse_response, path, atol=1e-4 * float(np.abs(path).max()))
    assert made.noise_psd == pytest.approx(kept.noise_psd, rel=1e-3)
