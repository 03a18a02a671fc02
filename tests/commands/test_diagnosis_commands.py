"""compare, diagnose, add and remove as typed: what they print and write, and one line for each kind of wrong input."""

from __future__ import annotations

import json

import numpy as np
import pytest
import soundfile

from edgefilter.cli import main
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE as RATE
from tests.commands.diagnosis_scene import arguments, fails_in_one_line
from tests.diagnosis.robot_scene import profile, record, voice
from tests.echo.own_effect import documented_file


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A folder with a profile and the recording of a robot whose volume was turned down by 3 dB."""
    folder = tmp_path_factory.mktemp("scene")
    x, robot = voice(8.0), profile()
    x[118_400:120_000] *= np.linspace(
        1, 0, 1600, dtype=np.float32
    )  # the last word ends, else what follows it is not evaluated
    robot.save(folder / "robot.npz")
    soundfile.write(folder / "ref.wav", x, RATE, "FLOAT")
    soundfile.write(
        folder / "mic.wav", record(x, robot.echo.with_effect("playback_gain", {"gain_db": -3.0})), RATE, "FLOAT"
    )
    return folder


def printed_json(capsys):
    return json.loads(capsys.readouterr().out)


def test_compare_says_in_ten_lines_how_much_is_unexplained_where_most_of_it_is_and_what_to_type_next(scene, capsys):
    assert main(arguments(scene, "compare")) == 0
    *lines, following = capsys.readouterr().out.splitlines()
    starts = [line[:12].strip() for line in lines]
    assert starts == ["excess", "lag", "silence", "worst band", "worst time", "worst lag", "more"]
    assert lines[5].startswith("worst lag   4 to 10 ms behind the reference: ") and max(map(len, lines)) <= 80
    files = " ".join(arguments(scene, "diagnose"))
    assert following == f"next        edgefilter {files}"


def test_compare_says_how_much_is_unexplained_and_where(scene, capsys):
    assert main(arguments(scene, "compare", "--verbose")) == 0
    *lines, following = capsys.readouterr().out.splitlines()
    out = "\n".join(lines)
    assert following.startswith("next        edgefilter diagnose --profile ")
    for words in (
        "excess ",
        "over the noise floor of -60.0 dBFS",
        "by frequency",
        "by time",
        "by level",
        "by lag",
        "silence",
    ):
        assert words in out, out
    assert max(map(len, lines)) <= 80
    assert main(arguments(scene, "compare", "--json", "-")) == 0
    found = printed_json(capsys)
    assert found["schema"] == 1 and found["excess_db"] > 3 and f"{found['excess_db']:.1f} dB" in out


@pytest.mark.slow
def test_add_lowers_the_error_and_remove_restores_the_profile(scene, tmp_path, capsys):
    better = tmp_path / "better.npz"
    assert main(arguments(scene, "add playback_gain", "--output", better, "--json", tmp_path / "add.json")) == 0
    out = capsys.readouterr().out
    assert "playback_gain added" in out and "gain_db = -3.0" in out and str(better) in out
    figures = json.loads((tmp_path / "add.json").read_text())
    assert figures["excess_after_db"] < 0.5 < figures["excess_before_db"] - 3
    assert figures["effects"]["playback_gain"]["at_run_time"] == "" and "NOTE" not in out
    assert figures["effects"]["playback_gain"]["parameters"]["gain_db"] == {
        "value": pytest.approx(-3.0, abs=0.02),
        "unit": "dB",
    }  # 0.02 dB: -53 dB of the voice
    assert main(arguments(scene, "compare", "--json", "-", profile=better)) == 0
    assert printed_json(capsys)["excess_db"] == pytest.approx(figures["excess_after_db"], abs=0.05)
    assert main(["remove", "playback_gain", "--profile", str(better), "--output", str(tmp_path / "as_before.npz")]) == 0
    assert "no effect left" in capsys.readouterr().out
    before, restored = Profile.load(scene / "robot.npz"), Profile.load(tmp_path / "as_before.npz")
    assert restored.echo.effects == () and np.array_equal(before.echo.impulse_response, restored.echo.impulse_response)


@pytest.mark.slow
def test_add_says_so_where_the_error_does_not_fall(scene, tmp_path, capsys):
    assert main(arguments(scene, "add playback_gain", "--output", tmp_path / "once.npz")) == 0
    assert (
        main(arguments(scene, "add playback_gain", "--output", tmp_path / "twice.npz", profile=tmp_path / "once.npz"))
        == 0
    )
    assert "the error did not fall" in capsys.readouterr().out


def test_a_fan_that_is_softer_than_the_profile_has_it_is_a_smaller_error(scene, tmp_path, capsys):
    """-6 dB before and 0 after is no error that did not fall; both ends of the range of --false-rate are in it."""
    louder = Profile.load(scene / "robot.npz")
    louder = louder.with_echo(
        louder.echo.with_effect("fan_noise", {"spectrum_db": np.full(601, 6.0), "change_db": 6.0})
    )
    louder.save(scene / "fan.npz")
    x, _ = soundfile.read(scene / "ref.wav", dtype="float32")
    soundfile.write(scene / "softer.wav", record(x), RATE, "FLOAT")
    words = arguments(scene, "diagnose", "--apply", tmp_path / "now.npz", profile="fan.npz", mic="softer.wav")
    for rate in ("0.000001", "0.5"):
        assert main([*words, "--false-rate", rate]) == 0
        out = capsys.readouterr().out
        assert "fan noise" in out and "did not fall" not in out
    assert Profile.load(tmp_path / "now.npz").echo.effects


@pytest.mark.slow
def test_add_says_what_the_running_filter_makes_of_an_effect_where_that_is_nothing(scene, tmp_path, capsys):
    command = arguments(scene, "add clock_drift", "--output", tmp_path / "drift.npz", "--json")
    assert main([*command, str(tmp_path / "add.json")]) == 0
    said = json.loads((tmp_path / "add.json").read_text())["effects"]["clock_drift"]["at_run_time"]
    assert "follows the clocks by itself" in said and f"NOTE        clock_drift: {said}" in capsys.readouterr().out


def test_diagnose_finds_what_is_missing_and_writes_the_documented_json(scene, tmp_path, capsys):
    assert main(arguments(scene, "diagnose", "--json", tmp_path / "d.json")) == 0
    found, out = json.loads((tmp_path / "d.json").read_text()), capsys.readouterr().out
    assert found["verdict"] == "missing" and [entry["effect"] for entry in found["ranking"]] == ["playback_gain"]
    assert found["ranking"][0]["parameters"]["gain_db"]["value"] == pytest.approx(
        -3.0, abs=0.02
    )  # 0.02 dB: -53 dB of the voice
    assert {
        "schema",
        "verdict",
        "excess_db",
        "noise_floor_db",
        "ranking",
        "evidence",
        "remaining_db",
        "irreducible_db",
        "where",
    } <= set(found)
    assert set(found["where"]) == {"bands", "times", "levels", "lags"}
    assert "verdict     missing: The recording differs from the profile by a turned volume." in out
    assert out.splitlines()[-1].startswith("next        edgefilter add playback_gain --profile ")
    assert len(out.splitlines()) <= 10 and "by frequency" not in out
    assert out.splitlines()[-2].endswith("; --prove: what it costs in the running filter")
    assert main(arguments(scene, "diagnose", "--prove")) == 0
    assert "running filter, " in (out := capsys.readouterr().out) and "--prove" not in out


@pytest.mark.slow
def test_what_no_effect_explains_is_written_as_one_of_my_own_which_add_takes(scene, tmp_path, capsys):
    x, mine, page = voice(6.0), tmp_path / "my_tremolo.py", tmp_path / "r.html"
    shaken = x * (1.0 + 0.5 * np.sin(2 * np.pi * 5.0 * np.arange(x.size) / RATE))
    for name, samples in (("said", x), ("shaken", record(shaken.astype(np.float32)))):
        soundfile.write(scene / f"{name}.wav", samples, RATE, "FLOAT")
    files = ["--recording", scene / "shaken.wav", "--reference", scene / "said.wav", "--profile", scene / "robot.npz"]
    words = ["diagnose", *files, "--write-effect", mine, "--report", page, "--verbose"]
    assert main([str(word) for word in words]) == 0
    out = capsys.readouterr().out
    assert "law         modulation: a gain that moves between " in out
    assert out.splitlines()[-1].startswith("next        edgefilter add my_tremolo ") and out.count("next  ") == 1
    assert "a law of the family <b>modulation</b>" in page.read_text()
    output = ["--effects", mine, "--output", tmp_path / "better.npz", "--json", "-"]
    assert main([str(word) for word in ["add", "my_tremolo", *files, *output]]) == 0
    told = printed_json(capsys)
    assert told["excess_after_db"] < 0.5 * told["excess_before_db"]
    assert told["proof"]["erle_after_db"] > told["proof"]["erle_before_db"] + 3.0


@pytest.mark.slow
def test_where_the_listed_effects_explain_all_no_effect_of_my_own_is_written(scene, tmp_path, capsys):
    mine = tmp_path / "mine.py"
    assert main(arguments(scene, "diagnose", "--write-effect", mine)) == 0
    assert f"{mine} is not written" in capsys.readouterr().out and not mine.exists()
    for name in ("mine.txt", "my effect.py", "rattle.py"):
        fails_in_one_line(
            capsys, arguments(scene, "diagnose", "--write-effect", tmp_path / name), 2, ["one word and no"]
        )


@pytest.mark.slow
@pytest.mark.parametrize("command", ["compare", "diagnose"])
def test_the_report_is_one_file_that_loads_nothing(scene, tmp_path, command, capsys):
    assert main(arguments(scene, command, "--report", tmp_path / "r.html")) == 0
    page = (tmp_path / "r.html").read_text()
    assert "{{" not in page.split("<script")[0] and "http://" not in page and "https://" not in page
    assert "mic.wav" in page and "default-src 'none'" in page
    assert str(tmp_path / "r.html") in capsys.readouterr().out


def test_other_rates_channels_and_formats_are_converted_and_said_so(scene, tmp_path, capsys):
    import soxr

    for name in ("mic", "ref"):
        x = soundfile.read(scene / f"{name}.wav")[0]
        up = soxr.resample(x, RATE, 44100)
        soundfile.write(tmp_path / f"{name}.flac", np.stack((up, up), axis=1), 44100, "PCM_24")
    assert main(arguments(scene, "compare", "--json", "-")) == 0
    plain = printed_json(capsys)["excess_db"]
    assert main(arguments(scene, "compare", "--json", "-", mic=tmp_path / "mic.flac", ref=tmp_path / "ref.flac")) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["excess_db"] == pytest.approx(plain, abs=0.3)  # the converters' roll-off near 8 kHz
    assert told.err.count("44100 Hz resampled") == 2 and "2 channels" in told.err


@pytest.fixture(scope="module")
def bad(scene):
    rng = np.random.default_rng(5)
    broken = rng.standard_normal(RATE) * 0.1
    broken[77] = np.nan
    (scene / "empty.wav").write_bytes(b"")
    soundfile.write(scene / "nan.wav", broken, RATE, "FLOAT")
    soundfile.write(scene / "silent.wav", np.zeros(8 * RATE), RATE)
    soundfile.write(scene / "short.wav", soundfile.read(scene / "mic.wav")[0][: RATE // 5], RATE, "FLOAT")
    soundfile.write(scene / "other.wav", 0.1 * rng.standard_normal(8 * RATE), RATE)
    np.savez(scene / "old.npz", version=np.array(99), header=np.frombuffer(b"{}", np.uint8))
    robot = profile()
    from dataclasses import replace

    replace(
        robot, echo=replace(robot.echo, effects=(("blade_chop", {"rate_hz": 23.0, "cosine": 0.1, "sine": 0.0}),))
    ).save(scene / "own.npz")
    return scene


@pytest.mark.parametrize("command", ["compare", "diagnose", "add playback_gain --output x.npz"])
@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({"mic": "none.wav"}, ["none.wav", "exist"]),
        ({"ref": "none.wav"}, ["none.wav", "exist"]),
        ({"mic": "empty.wav"}, ["empty.wav", "empty"]),
        ({"mic": "nan.wav"}, ["nan.wav", "sample 77"]),
        ({"ref": "silent.wav"}, ["reference", "silent.wav", "every sample is zero"]),
        ({"mic": "silent.wav"}, ["recording", "silent.wav", "every sample is zero"]),
        ({"mic": "short.wav"}, ["0.20 s"]),
        ({"mic": "other.wav"}, ["does not contain the reference"]),
        ({"profile": "none.npz"}, ["none.npz", "no such file"]),
        ({"profile": "old.npz"}, ["old.npz", "version is 99"]),
        ({"profile": "own.npz"}, ["own.npz", "blade_chop", "--effects"]),
    ],
)
def test_wrong_input_is_one_line_and_exit_1(bad, capsys, monkeypatch, tmp_path, command, files, expected):
    monkeypatch.chdir(tmp_path)
    fails_in_one_line(capsys, arguments(bad, command, **files), 1, expected)
    assert not (tmp_path / "x.npz").exists()


def test_wrong_usage_is_one_line_and_exit_2(scene, tmp_path, capsys):
    out = ["--output", tmp_path / "x.npz"]
    fails_in_one_line(capsys, arguments(scene, "add clok_drift", *out), 2, ["clok_drift", "clock_drift"])
    fails_in_one_line(
        capsys,
        ["remove", "clock_drift", "--profile", scene / "robot.npz", *out],
        2,
        ["holds no effect 'clock_drift'", "none"],
    )
    fails_in_one_line(capsys, ["compare", "--profile", scene / "robot.npz"], 2, ["--recording", "--reference"])
    fails_in_one_line(capsys, arguments(scene, "compare", "--effects", scene / "mic.wav"), 2, ["mic.wav", ".py"])
    fails_in_one_line(
        capsys, arguments(scene, "compare", "--report", tmp_path / "no/r.html"), 1, ["r.html", "No such file"]
    )


@pytest.mark.slow
def test_an_effect_of_ones_own_goes_through_every_command(tmp_path, capsys):
    x, robot = voice(8.0), profile()
    own = ["--effects", documented_file(tmp_path)]
    robot.save(tmp_path / "robot.npz")
    assert main(["profile", "show", str(tmp_path / "robot.npz"), *map(str, own)]) == 0  # registers it
    chopped = record(x, robot.echo.with_effect("blade_chop", {"rate_hz": 23.0, "cosine": 0.12, "sine": -0.2}))
    soundfile.write(tmp_path / "mic.wav", chopped, RATE, "FLOAT")
    soundfile.write(tmp_path / "ref.wav", x, RATE, "FLOAT")
    capsys.readouterr()
    assert main(arguments(tmp_path, "diagnose", *own, "--json", "-")) == 0
    (found,) = printed_json(capsys)["ranking"]
    assert found["effect"] == "blade_chop" and found["excess_after_db"] < 0.5 < 3 < found["excess_before_db"]
    assert found["parameters"]["rate_hz"]["value"] == pytest.approx(23.0, abs=1 / 32)  # the grid's step for 8 s
    assert (
        main(
            arguments(
                tmp_path, "add blade_chop", *own, "--output", tmp_path / "better.npz", "--json", tmp_path / "a.json"
            )
        )
        == 0
    )
    figures = json.loads((tmp_path / "a.json").read_text())
    assert figures["excess_after_db"] < 0.5 < 3 < figures["excess_before_db"]
    capsys.readouterr()
    assert main(["profile", "show", str(tmp_path / "better.npz"), *map(str, own)]) == 0
    assert "blade_chop" in capsys.readouterr().out
    files = ["--input", tmp_path / "mic.wav", "--reference", tmp_path / "ref.wav", "--output", tmp_path / "human.wav"]
    assert main([str(word) for word in ("run", "--profile", tmp_path / "better.npz", *own, *files, "--quiet")]) == 0
