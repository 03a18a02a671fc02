"""The yardstick of real devices, on a small robot of noise and clicks; nothing from outside, no network."""

import json
import sys

import numpy as np
import pytest
import soundfile as sf

from bench.measure import real, real_scores, real_streams, real_systems
from bench.measure.real_barge_in import THRESHOLDS, first_sound, in_time, noticed, replay
from bench.measure.real_scores import erle_by_second, excess_db
from bench.measure.real_streams import Cells, find_recordings, lay
from bench.measure.real_summary import summarise
from edgefilter import Event
from edgefilter.errors import UsageError

RATE = 16000
SHORT = Cells(sers=(0.0, -20.0), befores=(0.0, 1.0), noise_db=-30.0)


def bursts(seed, seconds):
    """Noise that comes and goes, as a voice does."""
    rng = np.random.default_rng(seed)
    envelope = np.repeat(rng.uniform(0.2, 1.0, 4 * seconds), RATE // 4)
    return (0.05 * envelope * rng.standard_normal(seconds * RATE)).astype(np.float32)


def write_pair(folder, name, ref, mic):
    sf.write(folder / f"{name}_lpb.wav", ref, RATE)
    sf.write(folder / f"{name}_mic.wav", mic, RATE)


@pytest.fixture
def recordings(tmp_path):
    """Two recordings of the robot alone, one of each other kind; loopbacks a little shorter, as in reality."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    for index, name in enumerate(
        ("device1_00", "device1_01", "x_doubletalk", "x_farend_singletalk", "x_nearend_singletalk")
    ):
        ref = bursts(index, 7)
        echo = 0.5 * np.roll(ref, 300)
        human = bursts(10 + index, 7) if index in (2, 4) else 0.0
        write_pair(folder, name, ref[:-100] if index != 4 else 0 * ref[:-100], human + (0 if index == 4 else echo))
    return folder


@pytest.fixture
def speech(tmp_path):
    folder = tmp_path / "speech"
    folder.mkdir()
    lines = []
    for index in range(2):
        sf.write(folder / f"{index}.wav", np.concatenate((np.zeros(RATE // 2), bursts(20 + index, 3))), RATE)
        lines.append(f"{index}.wav\t{index}\t3.50\tone two three")
    (folder / "transcripts.tsv").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture
def noise(tmp_path):
    folder = tmp_path / "noise"
    folder.mkdir()
    sf.write(folder / "fan.wav", bursts(30, 1), RATE)
    return folder


@pytest.fixture
def no_mos(monkeypatch):
    """AECMOS as on a machine without it."""
    monkeypatch.setitem(sys.modules, "speechmos.aecmos", None)
    real_scores.aecmos.cache_clear()
    yield
    real_scores.aecmos.cache_clear()


def laid(recordings, speech, noise, cases=2, seed=3):
    alone = [recording for recording in find_recordings(recordings, "device1_*") if recording.kind == "echo-only"]
    return lay(alone, speech, noise, SHORT, cases, seed)


def test_a_run_writes_every_table_and_names_what_is_absent(
    recordings, speech, noise, tmp_path, monkeypatch, no_mos, capsys
):
    def missing(*_):
        raise UsageError("AEC3 needs the package pywebrtc-audio: pip install pywebrtc-audio")

    monkeypatch.setitem(real_systems.PEERS, "aec3", missing)
    options = ["--speech", str(speech), "--noise", str(noise), "--cases", "2", "--ser=0,-20", "--before", "0,1"]
    output = tmp_path / "out" / "real"
    systems = ["--systems", "microphone,linear,aec3,dtln-aec"]
    assert real.main([str(recordings), *options, *systems, "--output", str(output)]) == 0
    content, page = json.loads(output.with_suffix(".json").read_text()), output.with_suffix(".md").read_text()
    assert content["absent"]["aec3"] == "AEC3 needs the package pywebrtc-audio: pip install pywebrtc-audio"
    assert {"dtln-aec", "AECMOS"} < set(content["absent"])
    assert set(content["summary"]) == {"microphone", "linear"}
    assert "- aec3: AEC3 needs the package" in page
    # 3 pairs, 2 alone, 2 cases x 2 levels x 2 times x with and without fan, for each of two systems
    assert len(content["rows"]) == 2 * (3 + 2 + 16)
    assert all(row["echo_mos"] is None for row in content["rows"] if row["part"] == "pairs")
    assert content["summary"]["linear"]["erle_median"] > 10  # an echo of one tap is learnt within the 7 s
    assert content["summary"]["microphone"]["erle_median"] == pytest.approx(0, abs=1e-6)
    assert output.with_suffix(".png").stat().st_size > 1000


def test_the_same_seed_gives_the_same_figures_with_one_process_and_with_two(recordings, speech, noise):
    tasks = [("linear", stream, None) for stream in laid(recordings, speech, noise)[:3]]
    nothing_kept = real.Scores(None)
    once = real.run(tasks, 1, nothing_kept)
    assert real.run(tasks, 2, nothing_kept) == once
    assert laid(recordings, speech, noise) == laid(recordings, speech, noise)
    assert laid(recordings, speech, noise) != laid(recordings, speech, noise, seed=4)


def test_kept_rows_are_taken_for_the_same_code_and_stream_only(recordings, speech, noise, tmp_path, monkeypatch):
    task, other = (("microphone", stream, None) for stream in laid(recordings, speech, noise)[:2])
    real.Scores(tmp_path / "kept.jsonl").keep(task, {"si_sdr": 1.0, "name": "{}"})
    assert real.Scores(tmp_path / "kept.jsonl").get(task) == {"si_sdr": 1.0, "name": "{}"}
    assert real.Scores(tmp_path / "kept.jsonl").get(other) is None
    microphone, peer = (("microphone", *task[1:]), ("aec3", *task[1:]))  # code of one file
    real.Scores(tmp_path / "kept.jsonl").keep(microphone, {"si_sdr": 2.0})
    assert real.Scores(tmp_path / "kept.jsonl").get(peer) is None
    monkeypatch.setattr(real, "_version", lambda system: "other code")
    assert real.Scores(tmp_path / "kept.jsonl").get(task) is None


def test_a_laid_human_has_its_level_its_place_and_its_time_alone(recordings, speech, noise):
    for stream in laid(recordings, speech, None):
        made = stream.signals()
        echo = stream.recording.signals().mic[stream.at - made.span.start :][: made.mic.size]
        np.testing.assert_allclose(made.mic - made.human, echo, atol=1e-6)
        assert made.span.start == round(stream.before * RATE)
        assert not made.human[: made.span.start].any()
        ser = 10 * np.log10(np.mean(made.human[made.span] ** 2) / np.mean(echo[made.span] ** 2))
        assert ser == pytest.approx(stream.ser, abs=0.01)


def test_the_fan_has_its_level_and_the_case_stays_the_same(recordings, speech, noise):
    streams = laid(recordings, speech, noise)
    quiet = {(s.case, s.ser, s.before): s for s in streams if s.noise is None}
    fans = [s for s in streams if s.noise]
    assert len(fans) == len(quiet) == 8
    for stream in fans:
        without = quiet[stream.case, stream.ser, stream.before]
        fan = stream.signals().mic - without.signals().mic
        robot = stream.recording.signals().mic
        assert 10 * np.log10(np.mean(fan**2) / np.mean(robot**2)) == pytest.approx(-30, abs=0.1)
        assert (stream.at, stream.speech) == (without.at, without.speech)


def test_a_sum_beyond_full_scale_is_turned_down_whole(recordings, speech):
    loud = np.clip(18 * bursts(0, 7), -1, 1)
    write_pair(recordings, "device1_00", loud, loud)
    stream = laid(recordings, speech, None, cases=1)[0]
    made = stream.signals()
    assert np.abs(made.mic).max() == pytest.approx(1.0)
    scale = np.std(made.mic - made.human) / np.std(loud[stream.at :][: made.mic.size])
    assert scale < 0.99


def test_split_takes_the_first_half_to_tune_and_the_second_to_report(recordings):
    found = find_recordings(recordings, "device1_*")
    tune, report = (real_streams.chosen(found, split, "*") for split in ("tune", "report"))
    assert [r.name for r in tune if r.kind == "echo-only"] == ["device1_00"]
    assert [r.name for r in report if r.kind == "echo-only"] == ["device1_01"]
    assert [r.kind for r in tune if r.kind != "echo-only"] == ["doubletalk", "farend", "nearend"]
    assert [r.name for r in real_streams.chosen(found, "all", "*_01") if r.kind == "echo-only"] == ["device1_01"]


def test_louder_than_the_microphone_is_found_in_one_second_of_ten():
    mic = bursts(0, 10)
    out = 0.1 * mic
    out[3 * RATE : 4 * RATE] = 2 * mic[3 * RATE : 4 * RATE]
    assert excess_db(out, mic) == pytest.approx(20 * np.log10(2), abs=0.01)
    assert excess_db(mic, mic) == 0
    assert excess_db(np.full(RATE // 2, 0.02, np.float32), np.full(RATE // 2, 0.01, np.float32)) == pytest.approx(
        6.02, abs=0.01
    )


def test_noise_out_of_digital_silence_counts_as_louder():
    assert excess_db(bursts(0, 2), np.zeros(2 * RATE, np.float32)) > 60


def test_erle_by_second_leaves_out_the_seconds_without_a_robot():
    mic = bursts(0, 3)
    mic[RATE : 2 * RATE] *= 1e-3
    assert erle_by_second(mic, 0.1 * mic) == [pytest.approx(20, abs=1e-3), None, pytest.approx(20, abs=1e-3)]


def test_first_sound_skips_silence_and_breath():
    human = np.concatenate((np.zeros(RATE), 0.001 * bursts(0, 1), bursts(1, 1))).astype(np.float32)
    assert first_sound(human) == 2 * RATE


@pytest.mark.parametrize(
    "kinds, expected",
    [
        ([("speech_started", 18000)], {"delay_s": 0.125, "early": False}),
        (
            [("speech_started", 100), ("speech_stopped", 9000), ("speech_started", 20000)],
            {"delay_s": 0.25, "early": False},
        ),
        (
            [("speech_started", 100), ("speech_stopped", 17000), ("speech_started", 18000)],
            {"delay_s": None, "early": True},
        ),
        ([("realigned", 17000)], {"delay_s": None, "early": False}),
    ],
)
def test_speech_that_was_on_already_is_not_noticed(kinds, expected):
    assert noticed([Event(kind, sample, "") for kind, sample in kinds], 16000) == expected
    assert in_time(expected) == (expected["delay_s"] is not None)


def test_the_curve_follows_the_packages_rule_at_another_threshold():
    hop = RATE // 10
    probability = [0.7, 0.85, 0.6, 0.3, 0.3, 0.5, 0.3, 0.3, 0.3, 0.3, 0.3, 0.9]
    events = [(event.kind, event.sample // hop) for event in replay(probability, hop, 0.8)]
    assert events == [("speech_started", 2), ("speech_stopped", 11), ("speech_started", 12)]
    assert replay(probability, hop, 0.95) == []


def test_summary_takes_quiet_humans_after_a_while_without_fan():
    base = {"part": "laid", "fan": False, "si_sdr_mic": -23.0, "excess_db": -1.0, "delay_s": 0.1, "early": False}
    base["curve"] = [1, 1, *[0] * (len(THRESHOLDS) - 2)]
    rows = [
        base | {"si_sdr": 4.0, "ser": -20.0, "before": 5.0, "wer_capped": 0.5},
        base | {"si_sdr": 0.0, "ser": -20.0, "before": 20.0, "wer_capped": 0.0},
        base | {"si_sdr": -25.0, "ser": -26.0, "before": 20.0, "wer_capped": 1.0},
        base | {"si_sdr": 99.0, "ser": -20.0, "before": 5.0, "fan": True, "delay_s": 0.5},
        base | {"si_sdr": 99.0, "ser": -10.0, "before": 5.0, "excess_db": 2.5},
        base | {"si_sdr": 99.0, "ser": -20.0, "before": 0.0},
    ]
    found = summarise(rows)
    assert (found["cases"], found["si_sdr"], found["si_sdr_worst"]) == (3, -7.0, -25.0)
    assert found["si_sdr_std"] == pytest.approx(np.std([4, 0, -25]))
    assert found["si_sdr_std_level"] == pytest.approx(np.sqrt((4 + 4 + 0) / 3))
    assert found["curve"] == []  # nothing is known of false starts
    alone = {
        "part": "alone",
        "seconds": 1800.0,
        "excess_db": 0.0,
        "erle_db": [3.0],
        "false_starts": 2,
        "curve": [4, *[0] * (len(THRESHOLDS) - 1)],
    }
    with_alone = summarise([*rows, alone])
    assert with_alone["curve"][0] == {"threshold": 0.5, "false_an_hour": 8.0, "in_time": 1.0}
    assert with_alone["curve"][2] == {"threshold": THRESHOLDS[2], "false_an_hour": 0.0, "in_time": 0.0}
    assert (found["below_microphone"], found["wer_capped"], found["in_time"], found["excess_db"]) == (
        1,
        0.5,
        2 / 3,
        2.5,
    )


def test_engines_that_judge_who_speaks_report_events_and_others_none(recordings):
    made = find_recordings(recordings, "device1_*")[0].signals()
    assert real_systems.listen("linear", made.mic, made.ref).events is None
    judged = real_systems.listen("crnn", made.mic, made.ref)
    assert judged.events is not None
    assert len(judged.probability) == -(-made.mic.size // judged.hop)
    assert max(judged.probability) > 0


def broken(folder, case):
    if case == "lone":
        (folder / "device1_00_lpb.wav").unlink()
    if case == "rate":
        sf.write(folder / "device1_00_mic.wav", bursts(0, 2), 8000)
    if case == "length":
        write_pair(folder, "device1_00", bursts(0, 7), bursts(0, 3))
    if case == "empty":
        write_pair(folder, "device1_00", bursts(0, 1)[:0], bursts(0, 1)[:0])
    if case == "short":
        write_pair(folder, "device1_00", bursts(0, 3), bursts(0, 3))
    if case == "kind":
        write_pair(folder, "kitchen", bursts(0, 3), bursts(0, 3))
    if case == "none":
        for path in folder.iterdir():
            path.unlink()


@pytest.mark.parametrize(
    "case, said",
    [
        ("none", "holds no *_lpb and *_mic files"),
        ("lone", "device1_00 without its _lpb file"),
        ("rate", "8000 Hz, 1 channels, expected 16000 Hz mono"),
        ("length", "device1_00: 3.00 s of microphone and 7.00 s of loopback, expected within 1 s as much"),
        ("empty", "device1_00: 0.00 s of microphone"),
        ("short", "device1_00: 3.0 s, expected 5.0 s for this human"),
        ("kind", "kitchen: expected doubletalk, farend, nearend in its name"),
    ],
)
def test_wrong_recordings_give_one_line(case, said, recordings, speech, tmp_path, capsys):
    broken(recordings, case)
    arguments = [str(recordings), "--speech", str(speech), "--before", "1", "--output", str(tmp_path / "out")]
    assert real.main(arguments) == 1
    shown = capsys.readouterr()
    assert said in shown.err
    assert shown.err.count("\n") == 1 and not shown.out
    assert not (tmp_path / "out.json").exists()


@pytest.mark.parametrize(
    "arguments, said",
    [
        ([], "found no --speech"),
        (["--speech", "SPEECH", "--only", "other*"], "no recording of the robot alone"),
        (["--speech", "NOWHERE"], "holds no transcripts.tsv"),
        (["--speech", "SPEECH", "--noise", "NOWHERE"], "holds no noise"),
        (["--parts", "alone", "--only", "other*"], "holds nothing for --parts alone"),
        (["--parts", "alone", "--systems", "louder"], "louder"),
    ],
)
def test_wrong_requests_give_one_line(arguments, said, recordings, speech, tmp_path, capsys):
    places = {"SPEECH": str(speech), "NOWHERE": str(tmp_path / "nowhere")}
    arguments = [places.get(argument, argument) for argument in arguments]
    assert real.main([str(recordings), "--before", "1", *arguments, "--output", str(tmp_path / "out")]) == 1
    shown = capsys.readouterr()
    assert said in shown.err
    assert shown.err.count("\n") == 1
