"""What the reports are made of: words, lines for the terminal, pictures and sound as data addresses, subsets of effects."""

from __future__ import annotations

import base64
import io
import json
import re
from dataclasses import replace
from importlib import resources
from types import SimpleNamespace

import numpy as np
import pytest
import soundfile
from PIL import Image

from edgefilter.audio.channels import Channels
from edgefilter.diagnosis.laws import Curve, Law
from edgefilter.diagnosis.recording import Recording, compare
from edgefilter.diagnosis.result import Diagnosis, Finding, Interval
from edgefilter.echo.effects.catalogue import EFFECTS, find
from edgefilter.report import text
from edgefilter.report.html import TERMS, choices, compare_variants, diagnosis_page
from edgefilter.report.media import LEVELS, MAX_COLUMNS, colour_scale, colours, sound, spectrogram_db, spectrogram_png
from edgefilter.report.text import LINES, add_command, coarser, comparison_summary, diagnosis_lines, summary_lines
from edgefilter.types import SAMPLE_RATE as RATE
from tests.diagnosis.robot_scene import office, profile, record, voice


def content(address: str) -> io.BytesIO:
    return io.BytesIO(base64.b64decode(address.split(",", 1)[1]))


def finding(name: str, values: dict, before: float = 9.0, after: float = 1.0) -> Finding:
    intervals = {key: Interval(value, value - 0.1, value + 0.1, "dB") for key, value in values.items()}
    evidence = f"Evidence for {name}."
    return Finding(name, "dynamics", 1e-5, before, after, 0.9, intervals, evidence, values, np.zeros(0, np.float32))


@pytest.mark.parametrize(
    ("interval", "said"),
    [
        (Interval(0.614, 0.561, 0.66, "s"), "0.614 s (0.561 to 0.660)"),
        (Interval(80.04, 79.0, 81.2, "1e-6"), "80.0 ppm (79.0 to 81.2)"),
        (Interval((7.5, 12.0), (7.4, 11.9), (7.6, 12.1), "s"), "7.50 s (7.40 to 7.60), 12.0 s (11.9 to 12.1)"),
        (Interval(4.0, 4.0, 4.0, "1"), "4.00"),
        (Interval(-31250.0, -31250.0, -31250.0, "samples"), "-31250 samples"),
        (Interval(2e-9, 1e-9, 3e-9, "1"), "2e-09 (1e-09 to 3e-09)"),
    ],
)
def test_parameters_read_as_people_write_them(interval, said):
    assert text.interval_text(interval) == said


def test_sentences_for_the_three_verdicts():
    assert (
        text.headline("missing", ["late_reverb", "clock_drift"])
        == "The recording differs from the profile by late reverberation and clock drift."
    )
    assert text.headline("explained", []) == "The profile explains this recording."
    assert "no known effect explains." in text.headline("unexplained", [])
    assert "something beside my own that" in text.headline("unexplained", ["my_own"])
    assert text.decibels(-0.04) == "0.0"


def test_every_built_in_effect_has_a_name_for_people():
    assert all(effect.title and text.spoken(effect.name) == effect.title for effect in EFFECTS)


def test_the_terminal_says_verdict_budget_parameters_and_what_is_left():
    x = voice(4.0)
    found = compare(profile(), record(x), x)
    two = (finding("late_reverb", {"rt60_s": 0.61}), finding("my_own", {"depth": 2.0}, 1.0, 0.3))
    lines = diagnosis_lines(Diagnosis("missing", found, two, "A hum at 50 Hz.", 0.3, 0.1, profile().echo))
    told = "\n".join(lines)
    assert lines[0] == "verdict     missing: The recording differs from the profile by late reverberation and my own."
    for part in (
        "with late_reverb",
        "rt60_s = 0.610 dB (0.510 to 0.710)",
        "9.0 to 1.0 dB, 90 %",
        "Evidence for my_own.",
        " dB over the fan: noise, whose waveform nothing predicts. A hum at 50 Hz.",
    ):
        assert part in told, part
    bars = [len(line) - len(line.rstrip("#")) for line in lines if line.startswith("  with ")]
    assert bars[0] > bars[1] > 0


def test_few_lines_say_what_is_wrong_how_sure_that_is_and_what_is_left():
    x = voice(4.0)
    found = replace(compare(profile(), record(x), x), warnings=tuple(f"warning {i}" for i in range(9)))
    two = (finding("late_reverb", {"rt60_s": 0.61}), finding("my_own", {"depth": 2.0}, 1.0, 0.3))
    diagnosis = Diagnosis("missing", found, two, "", 0.3, 0.0, profile().echo)
    lines = summary_lines(diagnosis)
    assert len(lines) == LINES - 2 and lines[0] == diagnosis_lines(diagnosis)[0]
    assert "9.0 to 1.0 dB, 90 % of the excess; " in lines[1] and "by chance" in lines[1]
    assert [line[:11].strip() for line in lines[5:]] == ["left", "WARNING", "WARNING"]
    assert lines[5].startswith("left        0.3 of ") and "noise floor" in lines[5]
    (left,) = (one for one in summary_lines(replace(diagnosis, irreducible_db=8.0)) if one.startswith("left"))
    assert left.startswith("left        8.0 of ") and "0.3" not in left


def test_a_comparison_has_ten_lines_too_and_no_worst_lag_where_nothing_depends_on_the_reference():
    x = voice(4.0)
    found = compare(profile(), record(x), x)
    assert [line[:12].strip() for line in comparison_summary(found)[3:]] == ["WARNING", "worst band", "worst time"]
    many = comparison_summary(replace(found, warnings=tuple(f"warning {i}" for i in range(9))))
    assert len(many) == LINES - 2 and [line[:7] for line in many[3:]] == 5 * ["WARNING"]


def test_a_range_that_says_nothing_is_not_told():
    low, high = next((p.low, p.high) for p in find("rattle").parameters if p.name == "threshold")
    one = replace(finding("rattle", {}), parameters={"threshold": Interval(0.1, low, high, "full scale")})
    assert text.known_parameters(one) == {"threshold": "0.100 full scale, which this recording hardly tells"}


RUN = "run --profile p.npz --input m.wav --reference r.wav"


@pytest.mark.parametrize(
    ("verdict", "effects", "names", "written", "said"),
    [
        ("missing", ["tilt"], {}, None, "add tilt --profile p.npz --recording m.wav --reference r.wav --output"),
        ("missing", ["tilt"], {}, "new.npz", "run --profile new.npz --input m.wav --reference r.wav --output"),
        ("explained", [], {"mic_channels": Channels([0, 2])}, None, f"{RUN} --mic-channels 0,2 "),
        ("explained", [], {"mic_channels": Channels()}, None, f"{RUN} --mic-channels all "),
        ("unexplained", [], {}, None, "diagnose --profile p.npz --recording m.wav --reference r.wav --report"),
        ("unexplained", [], {"report": "r.html"}, None, "calibrate --live"),
        ("explained", [], {"profile": None}, None, "calibrate --live"),
    ],
)
def test_one_command_follows(verdict, effects, names, written, said):
    known = {"profile": "p.npz", "recording": "m.wav", "reference": "r.wav", **names}
    found = SimpleNamespace(verdict=verdict, ranking=[finding(name, {}) for name in effects])
    assert text.next_command(found, known, written).startswith(f"edgefilter {said}")


def test_long_recordings_are_summed_up_by_power():
    times = [(i / 2, (i + 1) / 2, 10.0 if i % 2 else 0.0) for i in range(60)]
    rows = coarser(times, 12)
    assert len(rows) <= 12 and rows[0][0] == 0.0 and rows[-1][1] == 30.0
    assert rows[1][2] == pytest.approx(
        10 * np.log10((1 + 10 + 1 + 10 + 10) / 5)
    )  # rows of five half seconds, the second starts with a loud one


def test_a_tone_is_at_its_place_and_level_in_the_spectrogram():
    n = np.arange(4 * RATE)
    x = (0.5 * np.sin(2 * np.pi * 2000 * n / RATE) * (n >= 2 * RATE)).astype(np.float32)
    level = spectrogram_db(x)
    assert level.max() == pytest.approx(
        20 * np.log10(0.5), abs=0.1
    )  # a bin's centre is hit: only the window's samples differ
    image = Image.open(content(spectrogram_png(x, (-72.0, 0.0))))
    index = np.asarray(image)
    assert index.shape == (257, level.shape[0]) and image.palette.getdata()[1][:3] == colours()[0].tobytes()
    row = 256 - round(2000 / (8000 / 256))
    assert index[row, -10] == round((1 + 20 * np.log10(0.5) / 72) * (LEVELS - 1)) == index.max()
    assert not index[:, : level.shape[0] // 2 - 2].any()


def test_the_colours_reach_from_the_fan_to_the_voice():
    x = voice(6.0)
    fan = 1e-3 * np.random.default_rng(1).standard_normal(x.size).astype(np.float32)
    bottom, top = colour_scale(x + fan)
    assert bottom <= np.median(spectrogram_db(fan)) < bottom + 10  # the fan's own scatter and steps of 5 dB
    assert np.mean(spectrogram_db(x) > top) < 0.003
    silent_bottom, silent_top = colour_scale(np.zeros(16000, np.float32))
    assert silent_top - silent_bottom >= 40


def test_a_long_recording_gets_a_picture_of_bounded_width():
    x = voice(60.0)
    assert spectrogram_db(x).shape[0] == MAX_COLUMNS
    assert spectrogram_db(x[:100]).shape[0] == 1


def test_sound_is_what_was_recorded():
    x = voice(3.0)
    heard, rate = soundfile.read(content(sound(x, 1.0)))
    heard = heard[:: rate // RATE] if rate != RATE else heard
    assert abs(heard.size - x.size) <= 1
    assert np.corrcoef(heard, x)[0, 1] > 0.9  # Opus keeps the waveform of what is loud


def test_all_subsets_of_a_few_effects_and_the_prefixes_of_many():
    assert len(choices(3)) == 8 and choices(3)[0] == (False,) * 3 and choices(3)[-1] == (True,) * 3
    assert choices(4) == [tuple(i < on for i in range(4)) for on in range(5)]
    assert choices(0) == [()]


def test_subsets_are_compared_on_one_alignment():
    x, robot = voice(6.0), profile()
    model = robot.echo.with_effect("playback_gain", {"gain_db": -3.0})
    y = record(x, model)
    found = compare_variants(Recording(y, x, robot).straightened, model, [finding("playback_gain", {"gain_db": -3.0})])
    assert found[(True,)].excess_db < 0.3 < 3 < found[(False,)].excess_db  # 0.3 dB: see the comparison's own tests
    assert found[(True,)].offset_samples == found[(False,)].offset_samples


def test_what_no_waveform_predicts_does_not_stand_beside_what_the_findings_leave():
    x, robot = voice(3.0), profile()
    y = record(x)
    model = robot.echo.with_effect("playback_gain", {"gain_db": -3.0})
    one = (finding("playback_gain", {"gain_db": -3.0}),)
    found = Diagnosis("missing", compare(robot, y, x), one, "", 0.3, 8.0, model)
    page = diagnosis_page(Recording(y, x, robot), found, {"profile": "p", "recording": "m", "reference": "r"})
    assert "<dt>Left</dt><dd><b>8.0 dB</b> over the fan: noise" in page
    assert "With what was found" not in page and "<dt>Irreducible" not in page
    told = diagnosis_lines(found)
    assert not any("irreducible" in line for line in told) and any(
        line.startswith("left        8.0 of ") for line in told
    )


def test_what_the_running_filter_leaves_before_and_after_is_in_the_page_to_listen_to():
    x, robot = voice(6.0), profile()
    recording = Recording(record(x, office()), x, robot)
    proof = recording.prove("late_reverb")
    found = Diagnosis("missing", recording.compare(), (), "", 0.3, 0.0, robot.echo)
    names = {"profile": "p", "recording": "m", "reference": "r"}
    page = diagnosis_page(recording, found, names, proof=proof)
    data = json.loads(page.split('id="data">')[1].split("</script>")[0])
    before, after = (
        soundfile.read(content(data["media"][data["filtered"][key]["sound"]]))[0] for key in ("before", "after")
    )
    assert np.mean(after**2) < 0.5 * np.mean(before**2) and proof.erle_after_db > proof.erle_before_db + 3.0
    assert data["filtered"]["from_s"] == proof.start_s and "What the running filter leaves" in page
    assert "What the running filter leaves" not in diagnosis_page(recording, found, names)
    assert "left_before" not in proof.to_dict()


def test_each_section_of_the_page_has_its_words_explained_once_and_beside_it():
    page = resources.files("edgefilter.report").joinpath("page.html").read_text()
    assert re.findall(r'glossary\("(\w+)"\)', page) == list(TERMS)
    words = [term for section in TERMS.values() for term in section]
    assert len(words) == len(set(words)) >= 8


@pytest.mark.slow
def test_four_effects_give_five_comparisons_in_the_page():
    x, robot = voice(3.0), profile()
    y = record(x)
    four = [finding(name, {}) for name in ("playback_gain", "clock_drift", "compression", "speaker_nonlinearity")]
    model = robot.echo
    for one in four:
        model = model.with_effect(one.effect, one.values)
    found = Diagnosis("missing", compare(robot, y, x), tuple(four), "", 0.1, 0.0, model)
    page = diagnosis_page(Recording(y, x, robot), found, {"profile": "p", "recording": "m", "reference": "r"})
    assert page.count("<span>add</span>") == 1 and page.index("<span>add</span>") < page.index("Error budget")
    assert page.count('"excess_db"') == 5 and "switched with them" in page
    assert page.count("data:image/png") == 3, (
        "recording, prediction, residual: with neutral values all five comparisons share them"
    )


def test_the_page_draws_the_law_that_was_found():
    x, robot = voice(3.0), profile()
    y = record(x)
    curve = Curve("time", "s", (0.1, 0.2, 0.3), (-3.0, 1.0, 0.0), 0.5)
    law = Law("free_modulation", "modulation", "a gain that moves", curve, (), 1.0, 2.0, {})
    found = Diagnosis("unexplained", compare(robot, y, x), (), "", 9.0, 0.0, robot.echo, law=law)
    page = diagnosis_page(Recording(y, x, robot), found, {"profile": "p", "recording": "m", "reference": "r"})
    assert "<b>modulation</b>: A gain that moves." in page
    assert "Modulation: the law by time</b> <small>−3.0 to +1.0 dB" in page
    assert 'points="0.00,40.00 50.00,0.00 100.00,10.00"' in page and 'y1="10.00"' in page
    assert any(line.startswith("law         modulation: a gain that moves; ") for line in diagnosis_lines(found))


def test_the_command_to_add_is_one_that_a_shell_reads():
    names = {"profile": "my robot.npz", "recording": "m.wav", "reference": "r.wav", "effects": ["own.py"]}
    assert (
        add_command(["tilt"], names)
        == "edgefilter add tilt --profile 'my robot.npz' --recording m.wav --reference r.wav --effects own.py --output"
        " 'my robot.tilt.npz'"
    )
    assert add_command(["tilt"], {**names, "mic_channels": Channels([0, 2])}).endswith(
        "--effects own.py --mic-channels 0,2 --apply 'my robot.tilt.npz'"
    )


def test_a_switched_on_gain_control_is_scored_as_the_diagnosis_scores_it():
    x, robot = voice(6.0), profile()
    gain_db = 6 * np.hanning(240)
    model = robot.echo.with_effect("mic_agc", {"gain_db": gain_db, "knots_hz": 40.0})
    y = (record(x) * 10 ** (np.interp(np.arange(x.size) * 40 / 16000, np.arange(240), gain_db) / 20)).astype(np.float32)
    found = compare_variants(
        Recording(y, x, robot).straightened, model, [finding("mic_agc", {"gain_db": gain_db, "knots_hz": 40.0})]
    )
    assert (
        abs(found[(True,)].excess_db) < 0.3
        and abs(found[(True,)].silence_excess_db) < 0.3 < 3 < found[(False,)].excess_db
    )
