"""Recordings are what they are said to be: pairs of real devices, humans laid on them, the half that is kept apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import soundfile as sf

from bench import __main__ as program
from bench.recordings import TAIL_S, Cells, Laid, find_recordings, lay, lay_once, named, recorded_clip
from tests.bench.conftest import RATE, bursts, write_pair

SHORT = Cells(sers=(0.0, -20.0), befores=(0.0, 1.0))


def laid(pairs: Path, speech: Path, cases: int = 2, seed: int = 3) -> list[Laid]:
    alone = [one for one in find_recordings(pairs) if one.device == "device1"]
    return lay(alone, speech, SHORT, cases, seed)


def test_a_laid_human_has_its_level_its_place_and_its_time_alone(pairs: Path, speech: Path) -> None:
    for stream in laid(pairs, speech):
        made = stream.signals()
        echo = stream.recording.signals().mic[stream.at - made.span.start :][: made.mic.size]
        np.testing.assert_allclose(made.mic - made.human, echo, atol=1e-6)
        assert made.span.start == round(stream.before * RATE)
        assert not made.human[: made.span.start].any()
        ser = 10 * np.log10(np.mean(made.human[made.span] ** 2) / np.mean(echo[made.span] ** 2))
        assert ser == pytest.approx(stream.ser, abs=0.01)


def test_a_sum_beyond_full_scale_is_turned_down_whole(pairs: Path, speech: Path) -> None:
    loud = np.clip(18 * bursts(0, 7), -1, 1)
    write_pair(pairs, "device1_00", loud, loud)
    stream = laid(pairs, speech, cases=1)[0]
    made = stream.signals()
    assert np.abs(made.mic).max() == pytest.approx(1.0)
    scale = np.std(made.mic - made.human) / np.std(loud[stream.at :][: made.mic.size])
    assert scale < 0.99


def test_the_first_half_of_a_devices_recordings_is_to_tune_on_and_names_tell_who_talks(pairs: Path) -> None:
    found = {one.name: one for one in find_recordings(pairs)}
    assert [one.name for one in found.values() if one.tuned_on] == ["device1_00"]
    assert {one.device for one in found.values()} == {"device1", "x"}
    kinds = {name: one.kind for name, one in found.items()}
    assert (
        kinds["device1_01"] == kinds["x_farend_singletalk"] == "farend" and kinds["x_nearend_singletalk"] == "nearend"
    )
    assert kinds["x_doubletalk"] == "doubletalk"


def test_a_table_says_who_talks_when_and_the_first_of_several_microphones_is_heard(pairs: Path) -> None:
    (pairs.parent / "files.tsv").write_text(
        "name\tfar_end_alone_s\tdouble_talk_s\tnear_end_alone_s\n"
        f"{pairs.name}/x_doubletalk\t0.5-1\t1-1.5\t\nother/device1_00\t0-1\t\t\n"
    )
    path = pairs / "x_doubletalk_mic.wav"
    whole = sf.read(path, dtype="float32")[0]
    sf.write(path, np.stack((whole, -whole), axis=1), 16000, subtype="FLOAT")
    found = [one for one in find_recordings(pairs) if one.device == "x" and "doubletalk" in one.name]
    assert [(one.name, one.kind, one.seconds) for one in found] == [
        ("x_doubletalk doubletalk", "doubletalk", 1.5),  # what comes before is heard as well
        ("x_doubletalk farend", "farend", 0.5),
    ]
    assert np.array_equal(found[1].signals().mic, whole[8000:16000])
    assert {one.span for one in find_recordings(pairs) if one.device == "device1"} == {None}


def test_a_robot_over_which_a_wake_word_is_said_does_not_talk_alone(pairs: Path) -> None:
    (pairs / "files.tsv").write_text(
        "name\tfar_end_alone_s\tnote\nx_farend_singletalk\t1-6\tphone; wake word every 2.7 s\ndevice1_00\t1-6\tphone\n"
    )
    found = {one.name: (one.kind, one.span) for one in find_recordings(pairs)}
    assert found["x_farend_singletalk"] == ("doubletalk", (0, 6 * RATE))
    assert found["device1_00"] == ("farend", (RATE, 6 * RATE))


def test_the_same_seed_lays_the_same_humans(pairs: Path, speech: Path) -> None:
    assert laid(pairs, speech) == laid(pairs, speech) != laid(pairs, speech, seed=4)


def test_a_human_on_a_devices_only_recording_has_its_level_and_time_in_between(pairs: Path, speech: Path) -> None:
    (one,) = [one for one in find_recordings(pairs) if one.name == "x_farend_singletalk"]
    found = lay_once(one, speech, 4, (-14.0, -6.0), (2.0, 12.0), seed=1)
    assert found == lay_once(one, speech, 4, (-14.0, -6.0), (2.0, 12.0), seed=1)
    assert len({human.ser for human in found}) == 4 and all(-14 <= human.ser <= -6 for human in found)
    for human in found:
        signals = human.signals()
        assert 2 * RATE <= signals.span.start <= 7 * RATE - 3.5 * RATE  # 7 s of robot, 3.5 s of human
        assert signals.mic.size == signals.span.stop + round(TAIL_S * RATE) or signals.mic.size == 7 * RATE
    late = lay_once(one, speech, 1, (-14.0, -6.0), (5.0, 12.0), seed=1)[0]
    assert late.at == 7 * RATE - round((TAIL_S + 3.5) * RATE)  # as late as the recording allows


def test_a_clip_of_a_real_device_has_no_calibration_and_says_what_is_not_known(pairs: Path) -> None:
    (clip,) = named([recorded_clip(one) for one in find_recordings(pairs) if one.kind == "nearend"], "real")
    assert clip.profile is None and clip.human is None and clip.name == "real/x_nearend_singletalk"
    for ask, said in ((clip.fan, "the fan"), (clip.delayed_reference, "the true lag"), (clip.known_human, "the human")):
        with pytest.raises(Exception, match=said):
            ask()


def broken(folder: Path, case: str) -> None:
    if case == "lone":
        (folder / "x_farend_singletalk_lpb.wav").unlink()
    if case == "rate":
        sf.write(folder / "x_farend_singletalk_mic.wav", bursts(0, 2), 8000)
    if case == "length":
        write_pair(folder, "x_farend_singletalk", bursts(0, 7), bursts(0, 3))
    if case == "empty":
        write_pair(folder, "x_farend_singletalk", bursts(0, 1)[:0], bursts(0, 1)[:0])
    if case == "short":
        write_pair(folder, "x_farend_singletalk", bursts(0, 3), bursts(0, 3))
    if case == "none":
        for path in folder.iterdir():
            path.unlink()


@pytest.mark.parametrize(
    ("case", "said"),
    [
        ("none", "holds no *_lpb and *_mic files"),
        ("lone", "x_farend_singletalk without its _lpb file"),
        ("rate", "8000 Hz, 1 channels, expected 16000 Hz mono"),
        (
            "length",
            "x_farend_singletalk: 3.00 s of microphone and 7.00 s of loopback, expected lengths within 1 s of each other",
        ),
        ("empty", "x_farend_singletalk: 0.00 s of microphone"),
        ("short", "x_farend_singletalk: 3.0 s, expected 4.0 s for this human"),
        ("nobody", "holds no transcripts.tsv"),
    ],
)
def test_wrong_recordings_give_one_line(
    case: str, said: str, pairs: Path, speech: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken(pairs, case)
    people = tmp_path if case == "nobody" else speech
    arguments = ["devices", pairs, "--speech", people, "--before=1,2", "--output", tmp_path / "out", "--jobs", 1]
    arguments += ["--systems", "unfiltered", "--cases", "1", "--cache", tmp_path / "cache"]
    assert program.main([str(argument) for argument in arguments]) == 1
    shown = capsys.readouterr()
    assert said in shown.err and shown.err.count("\n") == 1 and not shown.out
    assert not (tmp_path / "out.json").exists()
