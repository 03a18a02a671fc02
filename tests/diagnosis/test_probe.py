"""Where two explanations remain a sound tells which is true, whichever it is; and what the command says of each mistake."""

from __future__ import annotations

import hashlib
import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import soundfile

from edgefilter.cli import main
from edgefilter.diagnosis.candidates import asks, remaining
from edgefilter.diagnosis.probe import ENOUGH, SOUND_S, Answer, Explanation, menu, weights
from edgefilter.diagnosis.recording import Recording
from edgefilter.diagnosis.result import Candidate
from edgefilter.dsp.fractional_delay import delayed
from edgefilter.echo.effects.catalogue import register
from edgefilter.echo.effects.playback_gain import PlaybackGain
from edgefilter.echo.model import EchoModel
from edgefilter.errors import SignalError, UsageError
from edgefilter.types import PRE_ROLL, SAMPLE_RATE
from tests.diagnosis.robot_scene import DELAY, path, profile, record, voice

COMPRESSION = {"threshold_db": -45.0, "ratio": 1.5, "attack_ms": 8.0, "release_ms": 900.0, "makeup_db": 4.0}
PAIRS = {
    "compression against gain": (("compression", COMPRESSION), ("playback_gain", {"gain_db": -3.0})),
    "ring against gain": (
        ("chassis_resonance", {"frequency_hz": 640.0, "q": 8.0, "gain_db": -8.0}),
        ("playback_gain", {"gain_db": -1.0}),
    ),
    "limiter against distortion": (
        ("limiter", {"ceiling_db": -20.0, "release_ms": 100.0}),
        ("speaker_nonlinearity", {"odd": np.array([-1.0, 0.2]), "knee": 0.3}),
    ),
    "fan against codec": (
        ("fan_noise", {"spectrum_db": 6.0, "change_db": 6.0}),
        ("codec", {"power": np.full(16, 2e-4), "decay_ms": 8.0, "exponent": 1.0}),
    ),
}


def heard(x: np.ndarray, name: str, values: dict, seed: int) -> np.ndarray:
    """(n + SAMPLE_RATE,) what the microphone records of a sound (n,), and a second more, with that effect."""
    rng, model = np.random.default_rng(seed), EchoModel(path()).with_effect(name, values)
    x = np.pad(x, (0, SAMPLE_RATE))
    y = record(x, model, seed=seed)
    for square, _ in model.unpredictable(x):
        y = y + np.sqrt(square) * rng.standard_normal(x.size)
    if name == "fan_noise":  # 6 dB louder: three more of the same power
        y = y + np.sqrt(3.0) * 1e-3 * rng.standard_normal(x.size)
    return y.astype(np.float32)


def trembling(x: np.ndarray, seed: int) -> np.ndarray:
    """(n + SAMPLE_RATE,) the same of a loudspeaker whose gain goes up and down five times a second, which no effect is."""
    x = np.pad(x, (0, SAMPLE_RATE))
    gain = 0.7 + 0.3 * np.cos(2 * np.pi * 5.0 * np.arange(x.size) / SAMPLE_RATE)
    return record((gain * x).astype(np.float32), seed=seed)


def softer(x: np.ndarray, seed: int) -> np.ndarray:
    """(n + SAMPLE_RATE,) the same of a loudspeaker that was turned down by 3 dB."""
    return heard(x, "playback_gain", {"gain_db": -3.0}, seed)


class Turned(PlaybackGain):
    """A turned volume under another name."""

    name = "turned"


VOLUME_OR_RING = (("playback_gain",), ("chassis_resonance",))


def unsteady(x: np.ndarray, seed: int) -> np.ndarray:
    """The same again with a gain that goes up and down a little as well, by 2 dB."""
    gain = 0.9 + 0.1 * np.cos(2 * np.pi * 5.0 * np.arange(x.size) / SAMPLE_RATE)
    return softer((gain * x).astype(np.float32), seed)


@pytest.mark.parametrize(("happened", "holds"), [(softer, True), (trembling, False)])
def test_what_is_nearer_is_named_only_where_it_holds(happened, holds: bool) -> None:
    """Of a volume and a ring the volume is nearer to a volume and to a tremolo, 20 to 1."""
    x, sound = voice(4.0), menu(voice(4.0))["noise"]
    inquiry = Recording(happened(x, 3), x, profile()).probe(VOLUME_OR_RING)
    answer = inquiry.answer([inquiry.hear(happened(sound, 5), sound)], [inquiry.gains(sound)], ("noise",))
    assert answer.first.name == "playback_gain" and answer.odds >= ENOUGH
    assert answer.holds == answer.settled == holds
    assert answer.left_db < 0.8 if holds else answer.left_db > 3.0  # what a diagnosis calls explained, and much


def follower(x: np.ndarray) -> np.ndarray:
    """A compressor of another design, (n,): 2.5 to 1 above -30 dB of an envelope that rises in 8 ms and falls in 250."""
    rises, falls = np.exp(-1.0 / (np.array([8e-3, 0.25]) * SAMPLE_RATE))
    envelope, level = np.empty(x.size), 0.0
    for at, now in enumerate(np.abs(x).tolist()):
        keep = rises if now > level else falls
        level = envelope[at] = keep * level + (1.0 - keep) * now
    over_db = np.maximum(20.0 * np.log10(envelope + 1e-9) + 30.0, 0.0)
    return (x * 10.0 ** (-0.6 * over_db / 20.0)).astype(np.float32)


def test_a_law_that_loud_words_have_taught_holds_though_it_errs_in_the_softest_sound() -> None:
    x = voice(12.0)
    inquiry = Recording(record(follower(x)), x, profile()).probe([("playback_gain",), ("compression",)])
    sound = menu(x)["noise, 20 dB softer"]
    heard = inquiry.hear(record(follower(np.pad(sound, (0, SAMPLE_RATE))), seed=5), sound)
    answer = inquiry.answer([heard], [inquiry.gains(sound)], ("noise",))
    assert answer.first.name == "compression" and answer.holds
    assert answer.in_answer and answer.left_db > 1.0


@pytest.mark.slow
def test_what_does_not_hold_is_not_asked_further() -> None:
    x = voice(4.0)
    inquiry = Recording(trembling(x, 3), x, profile()).probe(VOLUME_OR_RING)
    answer = inquiry.ask(lambda sound: trembling(sound.samples, 5), 60.0)
    assert answer.odds >= ENOUGH and not answer.settled and len(answer.sounds) < 24


def test_a_long_filter_that_the_recording_did_not_teach_holds_where_the_sounds_teach_it() -> None:
    """Two seconds of soft speech teach nothing of another path, as much of loud noise does."""
    x, sound, elsewhere = 0.12 * voice(4.0), menu(voice(4.0))["noise"], EchoModel(path(seed=2))
    inquiry = Recording(record(x, elsewhere), x, profile()).probe([("playback_gain",), ("early_path",)])
    heard = inquiry.hear(record(np.pad(sound, (0, SAMPLE_RATE)), elsewhere, seed=5), sound)
    answer = inquiry.answer([heard], [], ("noise",))
    assert answer.first.name == "early_path" and answer.settled and answer.left_db < 1.0  # no more than half of 3.6 dB


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS)
@pytest.mark.parametrize("true", [0, 1])
def test_five_seconds_settle_a_pair_whichever_is_true(pair: str, true: int) -> None:
    x, (name, values) = voice(5.0), PAIRS[pair][true]
    inquiry = Recording(heard(x, name, values, 3), x, profile()).probe([(one,) for one, _ in PAIRS[pair]])
    answer = inquiry.ask(lambda sound: heard(sound.samples, name, values, 5), 5.0)
    assert answer.settled and answer.first.name == name
    assert answer.to_dict()["explanations"][0]["effects"] == (name,)
    assert 1 <= len(answer.sounds) <= 2


def test_explanations_are_told_the_most_probable_first_with_the_odds_of_that():
    few, many = (Explanation((name,), None, None) for name in ("few", "many"))
    answer = Answer((few, many), np.array([1 / 30, 2 / 3, 0.3]), ("a sound",), True, 0.25, in_answer=False)
    assert answer.first is many and answer.odds == pytest.approx(2.0) and not answer.settled
    assert answer.to_dict() == {
        "settled": False,
        "odds": 2.0,
        "holds": True,
        "left_db": 0.25,
        "explanations": [{"effects": ("many",), "weight": 0.666667}, {"effects": ("few",), "weight": 0.033333}],
        "none": 0.3,
        "sounds": ("a sound",),
    }
    sure = replace(answer, likely=np.array([1.0, 0.0, 0.0]))
    assert sure.first is few and sure.settled and sure.odds == pytest.approx(1e6)
    nearest = replace(sure, holds=False)
    assert nearest.first is few and nearest.odds == sure.odds and not nearest.settled
    thirds = replace(answer, likely=np.array([7 / 9, 1 / 9, 1 / 9])).to_dict()
    assert (thirds["odds"], thirds["none"]) == (3.5, 0.111111)


def _levels_db(sound: np.ndarray) -> np.ndarray:
    """Of the five parts between the mark and the end."""
    parts = np.array_split(sound[round(0.4 * SAMPLE_RATE) : -round(0.1 * SAMPLE_RATE)], 5)
    return np.array([10 * np.log10(np.mean(part.astype(float) ** 2)) for part in parts])


def test_the_menu_has_twelve_sounds_no_louder_than_what_the_robot_says() -> None:
    x = voice(4.0)
    sounds = menu(x)
    assert len(sounds) == 12
    for words, sound in sounds.items():
        assert sound.dtype == np.float32 and sound.size == SOUND_S * SAMPLE_RATE, words
        assert 0.0 < np.abs(sound).max() <= np.abs(x).max() * (1 + 1e-6), words
    assert all(np.array_equal(sound, menu(x)[words]) for words, sound in sounds.items())
    assert np.array_equal(menu(0.5 * x)["noise"], 0.5 * sounds["noise"])
    steps = {way: _levels_db(sounds[f"five steps of level, {way}"]) for way in ("upwards", "downwards")}
    assert np.diff(steps["upwards"]) == pytest.approx(np.full(4, 8.0), abs=1.5)
    assert np.diff(steps["downwards"]) == pytest.approx(np.full(4, -8.0), abs=1.5)
    part = sounds["odd lines"][round(0.4 * SAMPLE_RATE) : -round(0.1 * SAMPLE_RATE)]
    spectrum = np.abs(np.fft.rfft(part))
    assert np.sum(spectrum[::2] ** 2) < 0.02 * np.sum(spectrum**2)  # what the fades leave at even lines


def test_weights_follow_the_evidence() -> None:
    rng = np.random.default_rng(0)
    found = rng.standard_normal((40, 3))
    likely = weights(found)
    assert likely.sum() == pytest.approx(1.0) and likely.argmax() == found.sum(axis=0).argmax()
    assert weights(found + rng.standard_normal((40, 1))) == pytest.approx(likely)  # only differences count
    assert weights(1000.0 * found) == pytest.approx(likely)  # and how steady they are
    assert weights(np.tile(found[:, :1], 2)) == pytest.approx([0.5, 0.5])
    steady = weights(np.stack((np.ones(40), np.zeros(40)), axis=1))
    assert steady[0] > 1.0 - 1e-6
    loud_once = weights(np.stack((np.eye(40)[0], np.zeros(40)), axis=1))
    assert loud_once[0] < ENOUGH / (1 + ENOUGH)  # one moment settles nothing


def test_by_chance_odds_of_twenty_to_one_come_as_seldom_as_they_should() -> None:
    """Of two that are equally far off each is settled on in 5 % of 2000 draws of 20 moments, the law of the test; 1.5 % more or less are chance."""
    rng = np.random.default_rng(1)
    sure = [max(weights(np.stack((d, -d), axis=1))) >= ENOUGH / (1 + ENOUGH) for d in rng.standard_normal((2000, 20))]
    assert np.mean(sure) == pytest.approx(0.095, abs=0.02)


def test_a_sound_that_would_not_be_found_again_is_not_played() -> None:
    """Where the clock runs 0.1 % fast and nobody has said so, what is expected of soft sounds is nearly all error."""
    x = voice(8.0)
    fast = np.interp(np.arange(x.size) * 0.999, np.arange(x.size), x).astype(np.float32)
    inquiry = Recording(record(0.6 * fast), x, profile()).probe([("playback_gain",), ("compression",)])
    worthy = inquiry.sounds(inquiry.before())
    assert 0 < len(worthy) < len(menu(x)) and worthy[0].expected > 0.0


def test_what_predicts_the_same_is_one_explanation_and_an_event_is_none() -> None:
    x, y = voice(4.0), softer(voice(4.0), 3)
    register(Turned())
    assert len(Recording(y, x, profile()).probe([("playback_gain",), ("turned",)]).explanations) == 1
    with pytest.raises(UsageError, match="delay_jump belongs to one recording"):
        Recording(y, x, profile()).probe([("delay_jump",), ("playback_gain",)])


def test_what_differs_only_by_what_the_fan_taught_is_one_explanation() -> None:
    x = voice(4.0)
    assert len(Recording(record(x, seed=1), x, profile()).probe(VOLUME_OR_RING).explanations) == 1


def test_a_louder_fan_that_the_profile_knows_is_expected_once() -> None:
    """A profile with a fan 6 dB louder as an effect says the same as one that was calibrated beside that fan."""
    x, calibrated = voice(4.0), profile()
    noise = 2e-3 * np.random.default_rng(5).standard_normal(x.size)
    y = EchoModel(path()).with_effect("playback_gain", {"gain_db": -1.0}).predict(delayed(x, DELAY - PRE_ROLL)) + noise
    louder = calibrated.with_echo(EchoModel(path()).with_effect("fan_noise", {"spectrum_db": 20 * np.log10(2.0)}))
    beside_it = replace(calibrated, noise_psd=4 * calibrated.noise_psd)
    told, expected = (
        Recording(y.astype(np.float32), x, each).probe(VOLUME_OR_RING).before() for each in (louder, beside_it)
    )
    assert told == pytest.approx(expected, rel=1e-4)


@pytest.mark.slow
def test_a_question_that_no_sound_answers_is_said() -> None:
    x = voice(4.0)
    y = heard(x, "compression", COMPRESSION, 3)
    inquiry = Recording(y, x, profile()).probe([("playback_gain",), ("compression",)])
    inquiry.explanations = (inquiry.explanations[0],) * 2
    with pytest.raises(SignalError, match="no sound tells playback_gain and playback_gain apart"):
        inquiry.sounds(np.ones(2))


def row(effect: str, gain_db: float, verdict: str = "explained by another") -> Candidate:
    return Candidate(effect, verdict, "", gain_db)


def test_what_explains_nearly_as_much_remains_and_events_do_not() -> None:
    named = row("compression", 5.0, "named")
    rivals = [row("limiter", 4.0), row("playback_gain", 3.0), row("mic_agc", 4.9), row("rattle", 4.9, "below its bar")]
    assert remaining([named, *rivals]) == (("compression",), ("limiter",))
    assert remaining([named]) == (("compression",),) and asks([named]) == ()
    both = remaining([named, row("late_reverb", 2.0, "named"), row("equaliser", 4.5), row("early_path", 6.0)])
    assert both == (("compression", "late_reverb"), ("early_path",))
    assert remaining([row("limiter", 1.0), row("rattle", 0.9)]) == (("limiter",), ("rattle",))
    assert remaining([]) == ()
    assert asks([named, *rivals]) == ("compression or limiter: edgefilter probe plays what tells them apart",)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a robot that compresses, a recording of it, and what the command wrote for it."""
    folder, x = tmp_path_factory.mktemp("probe"), voice(5.0)
    profile().save(folder / "robot.npz")
    soundfile.write(folder / "ref.wav", x, SAMPLE_RATE, "FLOAT")
    soundfile.write(folder / "mic.wav", heard(x, "compression", COMPRESSION, 3), SAMPLE_RATE, "FLOAT")
    assert main(asking(folder)) == 0
    sound, _ = soundfile.read(folder / "probe.wav", dtype="float32")
    soundfile.write(folder / "answer.wav", heard(sound, "compression", COMPRESSION, 5), SAMPLE_RATE, "FLOAT")
    return folder


def asking(folder: Path, *explanations: str) -> list[str]:
    named = {"profile": "robot.npz", "recording": "mic.wav", "reference": "ref.wav", "excitation": "probe.wav"}
    words = [word for role, file in named.items() for word in (f"--{role}", str(folder / file))]
    return ["probe", *(explanations or ("playback_gain", "compression")), *words]


def answering(
    folder: Path, recording: str = "answer.wav", sound: str = "probe.wav", robot: str = "robot.npz"
) -> list[str]:
    named = {"profile": robot, "recording": recording, "excitation": sound}
    return ["probe", *(word for role, file in named.items() for word in (f"--{role}", str(folder / file)))]


@pytest.mark.slow
def test_the_command_writes_the_sounds_and_evaluates_what_was_heard_of_them(written: Path, capsys) -> None:
    info = soundfile.info(written / "probe.wav")
    assert (info.samplerate, info.frames) == (SAMPLE_RATE, 2 * SOUND_S * SAMPLE_RATE)
    question = json.loads((written / "probe.wav.json").read_text())
    assert question["explanations"] == ["playback_gain", "compression"] and len(question["sounds"]) == 2
    assert main([*answering(written), "--json", str(written / "said.json")]) == 0
    said = capsys.readouterr().out
    assert "it is       compression" in said and "edgefilter add compression --profile" in said
    figures = json.loads((written / "said.json").read_text())
    assert figures["schema"] == 1 and figures["settled"] and figures["odds"] >= ENOUGH and figures["seconds"] == 5.0
    assert [one["effects"] for one in figures["explanations"]] == [["compression"], ["playback_gain"]]


def a_question(folder: Path, before, asked) -> list[str]:
    """The words that evaluate an answer to "a volume or a ring?", with the files that they need."""
    x, sound = voice(4.0), menu(voice(4.0))["noise"]
    profile().save(folder / "robot.npz")
    sounds = {"ref": x, "mic": before(x, 3), "probe": sound, "answer": asked(sound, 5)}
    for name, samples in sounds.items():
        soundfile.write(folder / f"{name}.wav", samples, SAMPLE_RATE, "FLOAT")
    digests = {
        f"{role}_sha256": hashlib.sha256((folder / file).read_bytes()).hexdigest()
        for role, file in (("profile", "robot.npz"), ("excitation", "probe.wav"))
    }
    files = {"recording": str(folder / "mic.wav"), "reference": str(folder / "ref.wav")}
    question = {"schema": 1, "explanations": ["playback_gain", "chassis_resonance"], "sounds": ["noise"]}
    (folder / "probe.wav.json").write_text(json.dumps({**question, **files, **digests}))
    return answering(folder)


@pytest.mark.parametrize(
    ("before", "asked", "nearest", "where", "recording", "reference"),
    [
        (trembling, softer, "playback_gain", "of the recording", "mic.wav", "ref.wav"),
        (softer, unsteady, "playback_gain", "of what was heard of the sounds", "answer.wav", "probe.wav"),
    ],
)
def test_what_is_nearer_and_does_not_hold_is_told_with_what_it_leaves_and_where_to_look_closer(
    tmp_path: Path, capsys, before, asked, nearest: str, where: str, recording: str, reference: str
) -> None:
    assert main([*a_question(tmp_path, before, asked), "--json", str(tmp_path / "said.json")]) == 0
    _, which, but, next_ = capsys.readouterr().out.splitlines()
    figures = json.loads((tmp_path / "said.json").read_text())
    assert not figures["settled"] and not figures["holds"] and figures["odds"] >= ENOUGH
    assert which.startswith(f"nearest     {nearest}, ") and f" to 1 ({nearest} " in which
    assert but.startswith(f"but         {nearest} leaves {figures['left_db']:.1f} dB over the noise floor {where}: ")
    command = ["edgefilter", "diagnose", "--profile", str(tmp_path / "robot.npz")]
    command += ["--recording", str(tmp_path / recording), "--reference", str(tmp_path / reference)]
    assert next_.startswith("next        ") and shlex.split(next_)[1:] == command


@pytest.mark.slow
def test_the_closer_look_finds_what_neither_explanation_is(tmp_path: Path, capsys) -> None:
    assert main(a_question(tmp_path, trembling, trembling)) == 0
    next_ = capsys.readouterr().out.splitlines()[-1]
    assert main(shlex.split(next_)[2:]) == 0
    assert "verdict     unexplained" in capsys.readouterr().out


@pytest.mark.slow
def test_what_nothing_predicts_is_said_and_named_by_none(written: Path, capsys) -> None:
    """A vacuum cleaner runs, 26 dB over the fan: neither is closer in a way that matters."""
    y, _ = soundfile.read(written / "answer.wav", dtype="float32")
    y += 0.02 * np.random.default_rng(0).standard_normal(y.size).astype(np.float32)
    soundfile.write(written / "strange.wav", y, SAMPLE_RATE, "FLOAT")
    assert main([*answering(written, "strange.wav"), "--json", str(written / "strange.json")]) == 0
    _, _, none, but, next_ = capsys.readouterr().out.splitlines()
    assert (
        none.startswith("none        of them predicts what was heard")
        and " dB over the noise floor of what was heard" in but
    )
    assert next_.startswith("next        edgefilter diagnose ") and str(written / "strange.wav") in next_
    figures = json.loads((written / "strange.json").read_text())
    assert not figures["settled"] and figures["none"] > 0.5


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        ("silent", "recording {folder}/silent.wav is silent"),
        ("other", "does not contain the reference (of"),
        ("sound", "excitation {folder}/probe.wav is not the one that {folder}/probe.wav.json was written with"),
        ("profile", "profile {folder}/robot.npz is not the one"),
        ("question", "{folder}/probe.wav.json is not there or holds no question"),
        ("schema", "{folder}/probe.wav.json has schema 9, expected 1"),
        ("moved", "mic.wav"),
        ("version", "version is 99, expected"),
    ],
)
def test_each_mistake_is_one_line_and_exit_code_1(
    written: Path, tmp_path: Path, capsys, damage: str, said: str
) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(written, folder)
    question = json.loads((folder / "probe.wav.json").read_text())
    recording, robot = "answer.wav", "robot.npz"
    if damage == "silent":
        recording = "silent.wav"
        soundfile.write(folder / recording, np.zeros(96_000), SAMPLE_RATE, "FLOAT")
    elif damage == "other":
        recording = "other.wav"
        soundfile.write(folder / recording, record(voice(6.0, seed=9)), SAMPLE_RATE, "FLOAT")
    elif damage == "sound":
        soundfile.write(folder / "probe.wav", voice(5.0), SAMPLE_RATE, "FLOAT")
    elif damage == "profile":
        profile(path(seed=2)).save(folder / robot)
    elif damage == "question":
        (folder / "probe.wav.json").write_text("{}")
    elif damage == "schema":
        (folder / "probe.wav.json").write_text(json.dumps({**question, "schema": 9}))
    elif damage == "moved":
        (folder / "probe.wav.json").write_text(json.dumps({**question, "recording": str(folder / "gone/mic.wav")}))
    else:
        with np.load(folder / robot) as file:
            fields = dict(file)
        np.savez(folder / "old.npz", **{**fields, "version": np.array(99)})
        robot = "old.npz"
    capsys.readouterr()
    assert main(answering(folder, recording, robot=robot)) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("edgefilter: ")]
    assert len(lines) == 1 and said.format(folder=folder) in lines[0], lines


def test_nothing_to_ask_is_said_as_such(written: Path, capsys) -> None:
    assert main(asking(written, "compression")) == 1
    assert "nothing to ask: compression is named" in capsys.readouterr().err
    register(Turned())
    assert main(asking(written, "playback_gain", "turned")) == 1
    assert "playback_gain and turned predict the same, under other names" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "expected one of --live"),
        (["--live", "--excitation", "a.wav"], "expected one of --live"),
        (["--excitation", "a.wav", "--seconds", "1"], "--seconds is 1, expected at least 2.5"),
        (["limiter", "--excitation", "a.wav"], "give --reference"),
        (["limitter", "--excitation", "a.wav"], "unknown effect 'limitter'"),
        (["--live"], "give --reference"),
    ],
)
def test_a_request_that_cannot_be_met_is_refused_before_any_work(words: list[str], said: str, capsys) -> None:
    assert main(["probe", *words, "--profile", "p.npz", "--recording", "m.wav"]) == 2
    assert said in capsys.readouterr().err
