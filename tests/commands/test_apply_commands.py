"""`add` with several names and `diagnose --apply` as typed: proof, refusal, --force, the JSON, one line for what is wrong."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
import soundfile

from edgefilter.cli import main
from edgefilter.profile.data import PROVISIONAL, Profile
from edgefilter.report.text import decibels
from edgefilter.types import SAMPLE_RATE as RATE
from tests.commands.diagnosis_scene import arguments, fails_in_one_line
from tests.diagnosis.robot_scene import RESONANCE, office, profile, record, voice

PROOF = {"effects", "start_s", "seconds", "erle_before_db", "erle_after_db", "without", "worse"}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """robot.npz; mic.wav of a robot with a ring and a turned volume; back.wav of one that is carried out of the office; short.wav, turned down."""
    folder = tmp_path_factory.mktemp("apply")
    x, robot = voice(9.0), profile()
    robot.save(folder / "robot.npz")
    rings = robot.echo.with_effect("chassis_resonance", RESONANCE).with_effect("playback_gain", {"gain_db": -3.0})
    back = record(x, office())
    back[86_400:] = record(x)[86_400:]
    short = record(x, robot.echo.with_effect("playback_gain", {"gain_db": -3.0}))[: RATE * 7 // 5]
    sounds = {"ref": x, "mic": record(x, rings), "back": back, "short": short}
    for name, samples in sounds.items():
        soundfile.write(folder / f"{name}.wav", samples, RATE, "FLOAT")
    return folder


@pytest.mark.slow
def test_two_effects_are_added_in_one_step_and_proven(scene: Path, tmp_path: Path, capsys) -> None:
    better, figures = tmp_path / "better.npz", tmp_path / "add.json"
    words = arguments(scene, "add chassis_resonance playback_gain", "--output", better, "--json", figures)
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "chassis_resonance and playback_gain added" in out and "playback_gain gain_db = -3.00 dB" in out
    assert "s held out: ERLE " in out and f"written to {better}" in out
    told = json.loads(figures.read_text())
    assert told.keys() == {
        "schema",
        "effects",
        "dropped",
        "excess_before_db",
        "excess_after_db",
        "noise_floor_db",
        "proof",
        "output",
    }
    assert told["schema"] == 2 and told["effects"].keys() == {"chassis_resonance", "playback_gain"}
    assert told["effects"]["playback_gain"]["parameters"]["gain_db"]["value"] == pytest.approx(-3.0, abs=0.03)
    assert told["proof"].keys() == PROOF and not told["proof"]["worse"]
    # the ring is what it brings: a volume alone the running filter finds with the first words
    assert told["proof"]["erle_after_db"] > told["proof"]["erle_before_db"] + 0.3
    assert [name for name, _ in Profile.load(better).echo.effects] == ["chassis_resonance", "playback_gain"]


@pytest.mark.slow
def test_what_makes_the_filter_worse_is_refused_in_one_line_without_a_file(scene: Path, tmp_path: Path, capsys) -> None:
    out, figures = tmp_path / "worse.npz", tmp_path / "worse.json"
    words = arguments(scene, "add late_reverb", "--output", out, "--json", figures, mic="back.wav")
    expected = ["late_reverb would make the running filter worse: ERLE ", "nothing is written", "--force"]
    fails_in_one_line(capsys, words, 1, expected)
    assert not out.exists() and not figures.exists()
    assert main([*words, "--force"]) == 0
    assert "late_reverb added" in capsys.readouterr().out
    assert json.loads(figures.read_text())["proof"]["worse"] is True
    assert [name for name, _ in Profile.load(out).echo.effects] == ["late_reverb"]


@pytest.mark.slow
def test_of_two_the_one_that_hurts_is_named(scene: Path, tmp_path: Path, capsys) -> None:
    words = arguments(scene, "add mic_clipping late_reverb", "--output", tmp_path / "x.npz", mic="back.wav")
    fails_in_one_line(capsys, words, 1, ["mic_clipping and late_reverb would make", "without late_reverb it is "])


@pytest.mark.slow
def test_all_that_is_found_is_applied_in_one_step(scene: Path, tmp_path: Path, capsys) -> None:
    """What is left is one figure in console, JSON and page, and `compare` has it of the profile that was written."""
    better, page, figures = tmp_path / "better.npz", tmp_path / "r.html", tmp_path / "d.json"
    assert main(arguments(scene, "diagnose", "--apply", better, "--report", page, "--json", figures, "--verbose")) == 0
    out, told = capsys.readouterr().out, json.loads(figures.read_text())
    left_db, last = told["applied"]["excess_after_db"], min(told["ranking"], key=lambda one: one["excess_before_db"])
    assert told["remaining_db"] == last["excess_after_db"] == pytest.approx(left_db, abs=1e-3)
    with_all = f"with {last['effect']}"
    assert f"floor before, {decibels(left_db)} dB after" in out and f"  {with_all:<27} {decibels(left_db):>6}" in out
    assert f"<dt>With what was found</dt><dd><b>{decibels(left_db)} dB</b>" in page.read_text()
    assert main(arguments(scene, "compare", "--json", "-", profile=better)) == 0
    assert json.loads(capsys.readouterr().out)["excess_db"] == pytest.approx(left_db, abs=1e-3)
    assert left_db < told["applied"]["promised_db"] + 0.5
    found = {entry["effect"] for entry in told["ranking"]}
    assert found == {"chassis_resonance", "playback_gain"} == told["applied"]["effects"].keys()
    assert told["applied"]["output"] == str(better) and told["applied"]["proof"].keys() == PROOF
    assert told["applied"]["excess_after_db"] < 0.5
    assert main(arguments(scene, "diagnose", profile=better)) == 0
    assert "verdict     explained" in capsys.readouterr().out


@pytest.mark.slow
def test_what_is_named_can_be_proven_first(scene: Path, tmp_path: Path, capsys) -> None:
    kept = tmp_path / "proven.json"
    assert main(arguments(scene, "diagnose", "--prove", "--json", kept)) == 0
    told = json.loads(kept.read_text())
    assert {entry["effect"] for entry in told["ranking"]} == {"chassis_resonance", "playback_gain"}
    assert told["proof"].keys() == PROOF and not told["proof"]["worse"]
    assert "proof       running filter, " in capsys.readouterr().out
    words = ["diagnose", "--prove", "--recording", str(scene / "mic.wav"), "--reference", str(scene / "ref.wav")]
    fails_in_one_line(capsys, words, 2, ["--prove without --profile"])


@pytest.mark.slow
def test_without_a_profile_one_is_made_and_proven_against_none(scene: Path, tmp_path: Path, capsys) -> None:
    made = tmp_path / "made.npz"
    files = ["--recording", str(scene / "mic.wav"), "--reference", str(scene / "ref.wav")]
    assert main(["diagnose", *files, "--apply", str(made), "--json", str(tmp_path / "a.json")]) == 0
    out = capsys.readouterr().out
    *_, written, _, following = out.splitlines()
    assert written == f"written to {made}" and following.startswith("next        edgefilter run ")
    proof = json.loads((tmp_path / "a.json").read_text())["applied"]["proof"]
    assert proof["erle_after_db"] > proof["erle_before_db"] + 3.0
    assert Profile.load(made).source == PROVISIONAL
    human = tmp_path / "human.wav"
    assert main([*shlex.split(following)[2:-1], str(human), "--engine", "linear", "--quiet"]) == 0
    before, after = (np.mean(soundfile.read(path)[0] ** 2) for path in (scene / "mic.wav", human))
    assert after < 0.02 * before


def test_where_nothing_was_found_no_file_is_written_and_a_line_says_so(scene: Path, tmp_path: Path, capsys) -> None:
    soundfile.write(scene / "same.wav", record(voice(9.0)), RATE, "FLOAT")
    same, page, figures = tmp_path / "same.npz", tmp_path / "r.html", tmp_path / "d.json"
    words = arguments(scene, "diagnose", "--apply", same, "--report", page, "--json", figures, mic="same.wav")
    assert main(words) == 0
    assert f"nothing was found to add: {same} is not written" in capsys.readouterr().out and not same.exists()
    assert "applied" not in json.loads(figures.read_text()) and "edgefilter add" not in page.read_text()


def test_a_diagnosis_that_is_refused_is_told_but_not_applied(scene: Path, tmp_path: Path, capsys) -> None:
    """Too short a recording to hold seconds out; with --force it is applied unproven."""
    out = tmp_path / "short.npz"
    words = arguments(scene, "diagnose", "--apply", out, mic="short.wav")
    fails_in_one_line(capsys, words, 1, ["too little of the robot alone to hold seconds out", "--force"])
    assert not out.exists()
    fails_in_one_line(
        capsys, arguments(scene, "add playback_gain", "--output", out, mic="short.wav"), 1, ["too little of the robot"]
    )
    assert not out.exists()
    assert main(arguments(scene, "add playback_gain", "--output", out, "--force", mic="short.wav")) == 0
    assert "proof       none: too little of the robot" in capsys.readouterr().out and out.exists()


def test_wrong_usage_is_one_line_and_exit_2(scene: Path, tmp_path: Path, capsys) -> None:
    out = ["--output", tmp_path / "x.npz"]
    fails_in_one_line(capsys, arguments(scene, "add playback_gain clok_drift", *out), 2, ["clok_drift", "clock_drift"])
    fails_in_one_line(capsys, arguments(scene, "add", *out), 2, ["EFFECT"])
    fails_in_one_line(capsys, arguments(scene, "diagnose", "--force"), 2, ["--force without --apply"])
    same = arguments(scene, "diagnose", "--apply", scene / "robot.npz")
    fails_in_one_line(capsys, same, 2, ["--apply", "robot.npz", "overwritten"])
    fails_in_one_line(capsys, arguments(scene, "diagnose", "--apply", tmp_path / "no/x.npz"), 1, ["No such file"])
    assert not (tmp_path / "x.npz").exists()


def test_what_an_added_effect_holds_is_shown_as_json_also_where_it_is_many_numbers(tmp_path: Path, capsys) -> None:
    robot = profile()
    gains = {"gain_db": np.linspace(0.0, 3.0, 240), "knots_hz": 40.0}
    robot.with_echo(robot.echo.with_effect("mic_agc", gains)).save(tmp_path / "agc.npz")
    assert main(["profile", "show", str(tmp_path / "agc.npz"), "--json", "-"]) == 0
    (shown,) = json.loads(capsys.readouterr().out)["effects"]
    assert shown["parameters"]["gain_db"] == pytest.approx(gains["gain_db"]) and shown["parameters"]["knots_hz"] == 40.0
