"""Where two explanations remain the sound that is chosen tells them apart, whichever is true."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import soundfile

from edgefilter.cli import main
from edgefilter.diagnosis.probe import Explanation, best_sound, menu, remaining, settled, weighed
from edgefilter.echo.model import EchoModel
from edgefilter.types import SAMPLE_RATE
from tests.diagnosis.robot_scene import path, profile, record, voice

PAIRS = {
    "gain against compression": (
        ("playback_gain", {"gain_db": -3.0}),
        ("compression", {"threshold_db": -45.0, "ratio": 1.5, "attack_ms": 8.0, "release_ms": 900.0, "makeup_db": 4.0}),
    ),
    "ring against gain": (
        ("chassis_resonance", {"frequency_hz": 640.0, "q": 8.0, "gain_db": -8.0}),
        ("playback_gain", {"gain_db": -1.0}),
    ),
    "limiter against distortion": (
        ("limiter", {"ceiling_db": -20.0, "release_ms": 100.0}),
        ("speaker_nonlinearity", {"odd": np.array([-1.0, 0.2]), "knee": 0.3}),
    ),
}


@pytest.mark.parametrize("pair", PAIRS)
@pytest.mark.parametrize("true", [0, 1])
def test_one_sound_settles_a_pair_whichever_is_true(pair: str, true: int) -> None:
    models = [EchoModel(path()).with_effect(name, values) for name, values in PAIRS[pair]]
    both = [Explanation((name,), model, 0.5) for (name, _), model in zip(PAIRS[pair], models, strict=True)]
    sound = best_sound(profile(), both, voice(4.0))
    found = weighed(profile(), both, sound.samples, record(sound.samples, models[true], seed=5))
    assert settled(found) and found[0].name == PAIRS[pair][true][0]
    assert found[0].weight + found[1].weight == pytest.approx(1.0)


def test_the_best_sound_is_expected_to_tell_more_than_any_other() -> None:
    (_, values), (_, others) = PAIRS["gain against compression"]
    both = [
        Explanation(("playback_gain",), EchoModel(path()).with_effect("playback_gain", values), 0.5),
        Explanation(("compression",), EchoModel(path()).with_effect("compression", others), 0.5),
    ]
    sounds = menu(voice(4.0), 2.5)
    assert len({words for words, _ in sounds}) == 12
    assert all(x.size == 2.5 * SAMPLE_RATE and np.isfinite(x).all() and np.abs(x).max() <= 1.0 for _, x in sounds)
    alike = [both[0], Explanation(("twin",), both[0].model, 0.5)]
    assert best_sound(profile(), both, voice(4.0)).expected > 10.0 * best_sound(profile(), alike, voice(4.0)).expected


def test_from_a_recording_to_its_explanation() -> None:
    x = voice(6.0)
    compressed = EchoModel(path()).with_effect(*PAIRS["gain against compression"][1])
    found = remaining(profile(), record(x, compressed), x)
    assert len(found) > 1 and "compression" in [each.name for each in found]
    sound = best_sound(profile(), found, x)
    after = weighed(profile(), found, sound.samples, record(sound.samples, compressed, seed=7))
    assert after[0].name == "compression" and settled(after)


def test_the_commands_write_the_sound_and_read_the_answer(tmp_path: Path, capsys) -> None:
    x, robot = voice(6.0), profile()
    turned = EchoModel(path()).with_effect("playback_gain", {"gain_db": -3.0})
    robot.save(tmp_path / "robot.npz")
    for name, samples in (("mic", record(x, turned)), ("ref", x)):
        soundfile.write(tmp_path / f"{name}.wav", samples, SAMPLE_RATE, "FLOAT")
    files = {"profile": "robot.npz", "recording": "mic.wav", "reference": "ref.wav", "excitation": "play.wav"}
    command = ["probe", *(word for key, name in files.items() for word in (f"--{key}", str(tmp_path / name)))]
    assert main(command) == 0
    assert "2.5 s of sound written" in capsys.readouterr().out
    sound, rate = soundfile.read(tmp_path / "play.wav", dtype="float32")
    assert rate == SAMPLE_RATE
    soundfile.write(tmp_path / "answer.wav", record(sound, turned, seed=3), SAMPLE_RATE, "FLOAT")
    assert main([*command, "--answer", str(tmp_path / "answer.wav"), "--json", "-"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["settled"] and said["explanations"][0]["effects"] == ["playback_gain"]


@pytest.mark.parametrize("words", [[], ["--live", "--excitation", "a.wav"], ["--live", "--answer", "a.wav"]])
def test_options_that_do_not_go_together_are_refused_before_any_work(words: list[str], capsys) -> None:
    assert main(["probe", "--profile", "p.npz", "--recording", "m.wav", "--reference", "r.wav", *words]) == 2
    assert "edgefilter: " in capsys.readouterr().err
