"""Without a calibration: the path and the fan from the recording itself, on a simulated robot, and what must not be claimed then."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import soundfile

from edgefilter.calibration.from_recording import PathFit, find_drift, self_calibrate
from edgefilter.cli import main
from edgefilter.dsp.fractional_delay import delayed
from edgefilter.echo.effect import Effect, Parameter
from edgefilter.echo.effects.catalogue import EFFECTS, register
from edgefilter.echo.model import EchoModel
from edgefilter.errors import SignalError, UsageError
from edgefilter.filter.ego_filter import enhance
from edgefilter.report.passport import SetUp
from edgefilter.types import SAMPLE_RATE as RATE
from tests.diagnosis.robot_scene import DELAY, FAN, path, record, voice

UNTOLD = {effect.name for effect in EFFECTS if effect.absorbed or effect.stage == "noise"}


@pytest.fixture(scope="module")
def said():
    return voice(10.0)


@pytest.fixture(scope="module")
def alone(said):
    return self_calibrate(record(said), said)


def test_path_lag_and_fan_are_those_of_the_robot(said, alone):
    assert alone.delay == DELAY
    early = slice(0, 800)
    error = alone.echo.impulse_response[early] - path()[early]
    assert np.sum(error**2) < 0.01 * np.sum(path()[early] ** 2)
    assert 10 * np.log10(np.mean(alone.noise_psd) / (FAN**2 / 8000)) == pytest.approx(
        0.0, abs=1.0
    )  # some 15 frames, the quieter half
    assert "made from the recording" in alone.source and "cannot be told" in alone.warnings[0]


def test_drift_is_found_and_sized(said):
    drifting = record(said, EchoModel(path()).with_effect("clock_drift", {"ppm": -120.0}))
    ppm, lag = find_drift(drifting, delayed(said, DELAY - 10))
    assert ppm == pytest.approx(-120.0, abs=6.0)  # 6 ppm: one sample in 10 s
    assert lag == pytest.approx(10, abs=1)
    assert find_drift(record(said), delayed(said, DELAY))[0] == 0.0


def test_a_talker_is_said_and_bends_the_path_little(said, alone):
    talk = voice(10.0, seed=77) * (np.arange(said.size) > 6 * RATE)
    made = self_calibrate(record(said) + talk, said)
    (told,) = [text for text in made.warnings if "another source" in text]
    assert "6." in told.split(" at ")[1]
    error = made.echo.impulse_response[:800] - path()[:800]
    assert np.sum(error**2) < 0.05 * np.sum(path()[:800] ** 2)
    assert not any("another source" in text for text in alone.warnings)


def test_without_a_robot_it_is_one_line(said):
    with pytest.raises(SignalError, match="does not contain the reference"):
        self_calibrate(voice(10.0, seed=5), said)
    with pytest.raises(SignalError, match="does a human talk nearly all the time"):
        self_calibrate(0.1 * record(said) + voice(10.0, seed=5), said)


def test_a_reference_that_loses_samples_is_the_likely_cause_where_no_path_is_learned(said):
    kept = np.arange(said.size) % RATE < RATE - 800
    cut = np.pad(said[kept], (0, said.size - int(kept.sum())))
    with pytest.raises(SignalError, match=r"samples are missing in the reference: .* by \d+ ms in 9 s"):
        self_calibrate(record(said), cut)


def test_a_filter_of_the_users_own_is_not_in_a_profile_that_others_may_load(said):
    class Own(Effect):
        name, stage, family = "my_filter", "path", "linear path"
        parameters = (Parameter("amount", "1", 0.0, 0.0, 2.0),)

    register(Own())
    held = {name for name, _ in self_calibrate(record(said), said).echo.effects}
    assert held == UNTOLD != set()


@pytest.mark.slow
def test_what_is_stationary_is_not_claimed_and_what_moves_is(tmp_path, said, capsys):
    said = said[: 6 * RATE]
    changed = (
        EchoModel(path()).with_effect("playback_gain", {"gain_db": 6.0}).with_effect("clock_drift", {"ppm": -120.0})
    )
    soundfile.write(tmp_path / "ref.wav", said, RATE, "FLOAT")
    soundfile.write(tmp_path / "mic.wav", record(said, changed), RATE, "FLOAT")
    files = ["--recording", str(tmp_path / "mic.wav"), "--reference", str(tmp_path / "ref.wav")]
    assert main(["compare", *files]) == 0
    assert "cannot be told" in capsys.readouterr().out
    assert main(["diagnose", *files, "--json", "-", "--report", str(tmp_path / "d.html")]) == 0
    told = json.loads(capsys.readouterr().out)
    names = [entry["effect"] for entry in told["ranking"]]
    assert names[0] == "clock_drift" and not set(names) & UNTOLD
    assert told["ranking"][0]["parameters"]["ppm"]["value"] == pytest.approx(-120.0, abs=5.0)
    assert any("cannot be told" in text for text in told["warnings"])
    page = (tmp_path / "d.html").read_text()
    assert "none: the recording itself" in page and "more than a stationary linear path" in page
    assert "edgefilter</span> <span>calibrate" in page and "edgefilter</span> <span>add" not in page


def test_add_needs_a_profile(tmp_path, capsys):
    assert (
        main(
            ["add", "clock_drift", "--recording", "m.wav", "--reference", "r.wav", "--output", str(tmp_path / "p.npz")]
        )
        == 2
    )
    assert "--profile" in capsys.readouterr().err


def test_a_filter_adapts_from_the_path_made_here_as_fast_as_from_a_learned_one(said, alone):
    """A sweep's path is held to be nearly right, and is left slowly: a recording of speech does not teach it so well."""
    moved = record(said, EchoModel(path()).with_effect("early_path", {"taps": 0.3 * np.roll(path(), 40)[:300]}))
    heard = np.arange(said.size) > 3 * RATE
    left = {
        source: np.mean(np.square(enhance(moved, said, replace(alone, source=source), engine="linear")[heard]))
        for source in (alone.source, "")
    }
    assert alone.learned and not replace(alone, source="").learned
    assert left[alone.source] < 0.8 * left[""]


def test_settings_are_above_zero():
    with pytest.raises(UsageError, match="taps is 0, expected more than 0"):
        PathFit(taps=0)
    with pytest.raises(UsageError, match="drift_ppm is -1, expected more than 0"):
        SetUp(drift_ppm=-1)
