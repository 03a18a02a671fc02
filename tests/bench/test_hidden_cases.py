"""The generator of recordings with hidden effects: its parts against simple oracles, each effect as strong as it says, cases that repeat."""

from __future__ import annotations

import ast
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf
from scipy import signal

from bench.simulate import hidden_cases, hidden_effects, hidden_robot
from bench.simulate.conversations import Clip, write_item
from bench.simulate.hidden_effects import CATALOGUE, CODECS, ENR_DB, OUTSIDE, RANGES, incoherent_db, through_codec
from bench.simulate.hidden_robot import Chain, Scene
from edgefilter.types import SAMPLE_RATE as RATE

BENCH = Path(__file__).parents[2] / "bench" / "simulate"
NAMES = ("sweep_ref", "sweep_mic", "fan_only", "ref", "mic")


def babble(seconds: float, seed: int) -> np.ndarray:
    """(n,) noise with the band and the syllables of speech, peak 0.8, silent at both ends."""
    rng = np.random.default_rng(seed)
    carrier = signal.sosfilt(
        signal.butter(2, [150, 3500], "band", fs=RATE, output="sos"), rng.standard_normal(int(seconds * RATE))
    )
    x = carrier * np.abs(
        signal.sosfilt(signal.butter(2, 4.0, fs=RATE, output="sos"), rng.standard_normal(carrier.size))
    )
    x *= signal.windows.tukey(x.size, 0.1)
    return 0.8 * x / np.abs(x).max()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return hidden_robot.draw_scene(np.random.default_rng(3), babble(5.0, 1), robot_over_fan_db=27.0)


def test_nothing_is_shared_with_the_product_but_its_metrics() -> None:
    files = [*BENCH.glob("hidden_*.py"), BENCH / "wild.py"]
    assert len(files) == 4
    for path in (*files, BENCH / "simulated_robot.py", BENCH / "conversations.py"):
        nodes = list(ast.walk(ast.parse(path.read_text())))
        names = [node.module for node in nodes if isinstance(node, ast.ImportFrom)]
        names += [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
        assert {name for name in names if name.startswith("edgefilter")} <= {"edgefilter.dsp.metrics"}, path.name


@pytest.mark.parametrize("samples", [0.0, 3.5, 700.123])
def test_fractional_delay_of_a_tone(samples: float) -> None:
    t = np.arange(4000)
    late = hidden_robot.fractional_delay(np.sin(0.3 * t), samples)
    np.testing.assert_allclose(
        late[1000:-100], np.sin(0.3 * (t - samples))[1000:-100], atol=2e-4
    )  # positions are rounded to 1/4096


def test_reading_at_another_clock() -> None:
    positions = np.arange(6000) * (1 + 200e-6) - 12.3
    np.testing.assert_allclose(
        hidden_robot.read_at(np.sin(0.5 * np.arange(7000)), positions)[100:], np.sin(0.5 * positions)[100:], atol=3e-4
    )


def test_reflection_arrives_when_geometry_says() -> None:
    place = hidden_robot.Place(np.full(3, 5.0), 0.5, 3, np.full(3, 2.0), np.full(3, 2.0))
    response = hidden_robot.reflector(np.random.default_rng(0), place)(1.0)
    assert abs(int(np.argmax(np.abs(response))) - 2.0 / 343 * RATE) < 2  # there and back, and the low-pass's delay


def test_compressor_in_steady_state_has_its_ratio() -> None:
    gain = hidden_effects.compressor_gain_db(
        np.full(RATE, 0.5), threshold_db=-26.0, ratio=4.0, knee_db=0.0, attack_ms=5.0, release_ms=100.0
    )
    assert gain[-1] == pytest.approx(-0.75 * (20 * np.log10(0.5) + 26.0), abs=0.01)


def test_agc_takes_away_its_slope_and_holds_in_silence() -> None:
    mic = np.concatenate([np.full(4 * RATE, 0.05), np.zeros(RATE)])
    gain = hidden_effects.agc_gain_db(
        mic, 0.5, target_db=-20.0, attack_ms=50.0, release_ms=200.0, limit_db=20.0, hold_db=-60.0
    )
    deviation = -20.0 - 20 * np.log10(0.05)
    assert gain[-1] == pytest.approx(0.5 * deviation, abs=0.1) and gain[-150] == gain[-1]


def test_soft_clip_leaves_small_signals_and_bounds_large_ones() -> None:
    x = 0.01 * np.sin(0.05 * np.arange(4000))
    np.testing.assert_allclose(
        hidden_effects.soft_clip(x, 1.0, 1.0, 8.0)[200:-200], x[200:-200], atol=2e-5
    )  # ripple of the resampling filter
    assert np.abs(hidden_effects.soft_clip(100 * x, 0.3, 0.3, 8.0)).max() < 0.33


def test_solve_finds_what_rises_and_what_falls() -> None:
    assert hidden_robot.solve(lambda x: x, 5.0, 0.1, 100.0, 0.01) == pytest.approx(5.0, abs=0.01)
    assert hidden_robot.solve(lambda x: -x, -5.0, 0.1, 100.0, 0.01) == pytest.approx(5.0, abs=0.01)


def test_scene_has_the_levels_that_it_was_asked_for(scene: Scene) -> None:
    noise = hidden_robot.power(scene.signals["fan_only"])
    assert hidden_robot.decibels(noise / scene.fan_power) == pytest.approx(0.0, abs=0.6)  # 8 s of narrow-band noise
    assert scene.over_fan_db(scene.echo(scene.usual)) == pytest.approx(
        27.0, abs=0.3
    )  # gain tolerance, distortion, move
    straight = replace(scene.usual, loudspeaker=replace(scene.usual.loudspeaker, drive=1e-4))
    assert scene.over_fan_db(scene.echo(scene.usual) - scene.echo(straight)) < -7.0


@pytest.mark.parametrize(
    ("effect", "strength"), [(effect, ("clear", "near")[i % 2]) for i, effect in enumerate(CATALOGUE)]
)
def test_effect_is_as_strong_as_it_says(scene: Scene, effect: str, strength: str) -> None:
    chain, parameters, found = hidden_cases.hide(np.random.default_rng(5), scene, scene.usual, effect, strength)
    assert parameters
    if effect in RANGES:
        assert found > ENR_DB["near"] - 1
    else:
        assert found == pytest.approx(ENR_DB[strength], abs=1.0)
    assert np.isfinite(scene.record(chain)).all()


def made(scene: Scene, effect: str, strength: str = "clear") -> tuple[Chain, dict]:
    return CATALOGUE[effect](np.random.default_rng(2), scene, scene.usual, strength)


def test_path_is_the_old_one_before_the_change(scene: Scene) -> None:
    chain, parameters = made(scene, "path_change")
    difference = np.abs(scene.record(chain) - scene.record(scene.usual))
    start = int(parameters["time_s"] * RATE)
    assert difference[:start].max() < 1e-9 and difference[start + RATE // 2 :].max() > 1e-3


def test_drift_moves_the_voice_by_its_ppm(scene: Scene) -> None:
    chain, parameters = made(scene, "clock_drift")
    lag = np.diff(chain.lag[[0, -1]])[0]
    assert lag == pytest.approx(
        -parameters["ppm"] * 1e-6 * (chain.lag.size - 1), abs=0.13
    )  # twice the wander's amplitude


def test_jump_shifts_what_is_played_behind_it(scene: Scene) -> None:
    chain, parameters = made(scene, "delay_jump")
    total, last = sum(parameters["samples"]), int(parameters["time_s"][-1] * RATE) + 1000
    expected = hidden_robot.read_at(scene.reference, np.arange(scene.reference.size) - total)
    np.testing.assert_allclose(chain.played[last:], expected[last:], atol=1e-9)


def test_clipped_recording_never_exceeds_the_level(scene: Scene) -> None:
    chain = scene.usual
    for seed in range(8):
        chain, parameters = CATALOGUE["mic_clipping"](np.random.default_rng(seed), scene, scene.usual, "moderate")
        if parameters["kind"] == "converter":
            break
    mic = scene.record(chain)
    assert np.abs(mic).max() == parameters["level"] and np.sum(np.abs(mic) == parameters["level"]) > 10


def test_changed_fan_is_louder_by_what_it_says(scene: Scene) -> None:
    chain, parameters = made(scene, "fan_noise")
    settled = slice(int((parameters["from_s"] + 2) * RATE) if parameters["from_s"] else 0, None)
    assert hidden_robot.decibels(hidden_robot.power(chain.fan[settled]) / scene.fan_power) == pytest.approx(
        parameters["change_db"], abs=1.0
    )


def test_late_reverberation_decays_with_its_rt60(scene: Scene) -> None:
    chain, parameters = made(scene, "late_reverb")
    decay = np.cumsum(chain.paths[0][2][::-1] ** 2)[::-1]
    decay_db = 10 * np.log10(decay / decay[int(0.02 * RATE)])
    fall = np.flatnonzero(decay_db < -5)[0], np.flatnonzero(decay_db < -25)[0]
    assert 3 * (fall[1] - fall[0]) / RATE == pytest.approx(
        parameters["rt60_s"], rel=0.35
    )  # Sabine's formula misses by a quarter


@pytest.mark.parametrize("kind", [name for name in OUTSIDE if name != "codec"])
def test_disturbance_is_as_strong_as_it_says(scene: Scene, kind: str) -> None:
    chain, _ = OUTSIDE[kind](np.random.default_rng(4), scene, scene.usual, "moderate", lambda rng: babble(2.0, 7))
    found = scene.over_fan_db(scene.record(chain) - scene.record(scene.usual))
    assert found == pytest.approx(ENR_DB["moderate"], abs=1.0)


def test_coherence_tells_noise_from_a_filter() -> None:
    x, noise = babble(20.0, 1), np.random.default_rng(2).standard_normal(20 * RATE)
    filtered = signal.lfilter([0.5, 0.3, 0.2], 1.0, x)
    noise *= 0.1 * np.std(filtered)
    # Welch's estimate of the coherence has a bias of 1/segments, 600 segments of this length
    assert incoherent_db(x, filtered) < -25 and incoherent_db(x, filtered + noise) == pytest.approx(-20, abs=1.5)


def test_missing_ffmpeg_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(SystemExit, match="ffmpeg was not found"):
        through_codec(np.zeros(RATE), "gsm", CODECS["gsm"][-1][0])


@pytest.fixture(scope="module")
def voices(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Clip]]:
    folder = tmp_path_factory.mktemp("voice")
    for i in range(9):
        sf.write(folder / f"{i}.flac", babble(3.2, i), RATE)
    return {"a": [Clip(folder / f"{i}.flac", "a", "words") for i in range(9)]}


def test_a_case_repeats_and_its_files_are_what_it_says(
    voices: dict[str, list[Clip]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hidden_cases, "SECONDS", (5.0, 6.0))
    signals, truth = hidden_cases.make_case(9, 2, "singles", voices)
    again, _ = hidden_cases.make_case(9, 2, "singles", voices)
    np.testing.assert_array_equal(signals["mic"], again["mic"])
    write_item(tmp_path / "case", signals, "truth", truth)
    read = json.loads((tmp_path / "case" / "truth.json").read_text())
    assert read["effects"] == ["playback_gain"] and read["strength"] == "clear" and read["seed"] == [9, 2]
    assert abs(read["tolerances"]["offset_samples"]) <= 60 and abs(read["tolerances"]["fan_db"]) <= 0.4
    for name in NAMES:
        samples, rate = sf.read(tmp_path / "case" / f"{name}.flac")
        assert rate == RATE and np.abs(samples).max() < 1.0
        np.testing.assert_allclose(samples, signals[name], atol=2**-15)


def test_sets_hide_what_they_promise() -> None:
    draw = {
        kind: [hidden_cases.draw_effects(np.random.default_rng(i), i, kind) for i in range(78)]
        for kind in hidden_cases.SETS
    }
    singles = {(effects[0], strength) for effects, strength in draw["singles"]}
    assert singles == {(effect, strength) for effect in CATALOGUE for strength in ENR_DB}
    assert all(effects == [] for effects, _ in draw["controls"])
    assert all(len(effects) == 2 and frozenset(effects) not in hidden_cases.APART for effects, _ in draw["pairs"])
    assert {effects[0] for effects, _ in draw["outside"]} == set(OUTSIDE)
    assert set(hidden_cases.ALONG_THE_CHAIN) == set(CATALOGUE)
