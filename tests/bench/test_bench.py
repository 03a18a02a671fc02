"""The benchmark judged by itself.

Conversations that are what their meta.json says, peers that cancel, figures that add up.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import soundfile as sf
from scipy import signal

import edgefilter
from bench.measure import barge_in, conversation, intervals, levels, peers, quality, recogniser, scores
from bench.simulate import conversations
from bench.simulate import simulated_robot as robot
from edgefilter.dsp.metrics import erle, si_sdr
from edgefilter.errors import UsageError
from edgefilter.types import Event
from tests.bench.conftest import RATE, babble, make


def read(folder: Path, name: str) -> np.ndarray:
    return sf.read(folder / f"{name}.flac")[0]


def lag_between(mic: np.ndarray, ref: np.ndarray) -> float:
    """Samples by which ref must be delayed to fit mic.

    Peak of the whitened cross-correlation, interpolated by a parabola.
    """
    size = 1 << (2 * ref.size).bit_length()
    played = np.fft.rfft(ref, size)
    power = np.abs(played) ** 2
    h = np.abs(np.fft.irfft(np.fft.rfft(mic, size) * played.conj() / (power + 1e-2 * power.max())))
    k = int(np.argmax(h[: RATE * 2]))
    left, top, right = h[k - 1], h[k], h[k + 1]
    return k + 0.5 * (left - right) / (left - 2 * top + right)


def test_live_conversation_has_the_delays_that_its_meta_says(live: Path) -> None:
    folders = sorted(live.iterdir())
    assert [folder.name for folder in folders] == ["lab_00", "office_01"]
    for folder in folders:
        meta = json.loads((folder / "meta.json").read_text())
        mic, ref = read(folder, "mic"), read(folder, "ref")
        assert 10 <= abs(meta["ppm"]) <= 300 and meta["lag"] != meta["lag2"] and abs(meta["volume_db"]) <= 3
        for at, until, lag in ((0, meta["t_main"], meta["lag"]), (meta["t_main"], meta["start"], meta["lag2"])):
            stop = min(at + 5 * RATE, until)
            segment = np.zeros_like(ref)
            segment[at:stop] = ref[at:stop]
            arriving = np.interp(np.arange(ref.size) * (1 + meta["ppm"] * 1e-6) - lag, np.arange(ref.size), segment)
            # what is left is the delay of the calibration; half a sample for rounding, half for the distortion
            assert lag_between(mic[: stop + lag + RATE // 2], arriving) == pytest.approx(meta["delay"], abs=1)


def test_conversation_levels_and_spans(live: Path) -> None:
    for folder in sorted(live.iterdir()):
        meta = json.loads((folder / "meta.json").read_text())
        mic, clean, fan = (read(folder, name) for name in ("mic", "clean", "fan_only"))
        span = slice(meta["start"], meta["end"])
        assert not clean[: meta["start"]].any() and clean[span].any()
        assert mic.size == clean.size == read(folder, "ref").size and fan.size == 8 * RATE
        assert si_sdr(mic[span], clean[span]) == pytest.approx(
            meta["sisdr_mix"], abs=0.05
        )  # 16-bit rounding of the clean human
        fan_db = 10 * np.log10(np.mean(clean[span] ** 2) / np.mean(fan**2))
        assert fan_db == pytest.approx(
            meta["snr_fan"], abs=0.5
        )  # 8 s of narrow-band noise estimate their power to some tenths
        assert np.abs(mic).max() < 1.0


def test_an_item_does_not_depend_on_how_many_are_made(clips: Path, live: Path, tmp_path: Path) -> None:
    make(clips, tmp_path / "again", "live", 1)
    for name in ("mic", "ref", "sweep_mic", "fan_only"):
        np.testing.assert_array_equal(read(tmp_path / "again" / "lab_00", name), read(live / "lab_00", name))


def test_rooms_and_levels_as_published(clips: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rooms = [conversations.room_of(i, published=True) for i in range(80)]
    assert rooms.count("lab") == 18 and "lab" in rooms[:1] and "lab" in rooms[70:]  # 1800 of 8000, spread over all
    assert conversations.PUBLISHED_DB == {"lab": (-22.0, 3.28), "office": (-26.3, 4.29)}  # the paper's Table 2
    monkeypatch.setattr(conversations, "PUBLISHED_DB", {"office": (-20.0, 0.0)})
    monkeypatch.setattr(conversations, "UNFILTERED_DB", {"office": (-26.0, 0.0)})
    speech, voices = conversations.read_clips(clips, (3.0, 12.0)), conversations.read_voices([clips])
    loud, soft = (
        conversations.make_scene(7, 1, "paper", speech, voices, published=published).signals["clean"]
        for published in (True, False)
    )
    np.testing.assert_allclose(loud, 10 ** (6 / 20) * soft, atol=1e-9)


def test_lost_packets_are_silent_where_the_notes_say_and_nothing_else_changes(clips: Path) -> None:
    speech, voices = conversations.read_clips(clips, (3.0, 12.0)), conversations.read_voices([clips])
    whole, lossy = (conversations.make_scene(7, 0, "paper", speech, voices, lost=share) for share in (0.0, 0.1))
    np.testing.assert_array_equal(whole.signals["ref"], lossy.signals["ref"])
    ref, lost, lag = lossy.signals["ref"], lossy.meta["lost"], lossy.meta["lag"]
    loud = np.add.reduceat(ref**2, np.arange(0, ref.size, 320)) > 1e-3 * np.mean(ref**2) * 320
    assert len(lost) == pytest.approx(0.1 * loud.sum(), rel=0.6) and "lost" not in whole.meta
    heard = conversations.played(ref, lossy.meta)
    assert not any(heard[lag + first : lag + first + 320].any() for first in lost)
    changed = np.flatnonzero(heard != conversations.played(ref, whole.meta)) - lag
    assert set(changed // 320 * 320) == set(lost)


def test_folder_without_transcripts_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="transcripts.tsv is missing"):
        conversations.read_clips(tmp_path, (3.0, 12.0))


@pytest.mark.parametrize("ppm", [-300.0, 10.0, 250.0])
def test_warp_reads_at_the_other_clock(ppm: float) -> None:
    t = np.arange(4 * RATE)
    warped = robot.warp(np.sin(2 * np.pi * 0.31 * t), ppm)
    inside = slice(100, -100)
    np.testing.assert_allclose(
        warped[inside], np.sin(2 * np.pi * 0.31 * t * (1 + ppm * 1e-6))[inside], atol=3e-5
    )  # -90 dB images


def test_loudspeaker_is_linear_when_barely_driven_and_distorts_when_driven() -> None:
    from dataclasses import replace

    driver, x = robot.draw_loudspeaker(np.random.default_rng(2)), babble(2.0, 1).astype(np.float64)
    distortion = [
        -si_sdr(replace(driver, drive=drive).play(x), driver.play(x, linear=True)) for drive in (1e-4, 1.0, 4.0)
    ]
    assert (
        distortion[0] < -60 and distortion[0] < distortion[1] - 10 < distortion[2] - 15
    )  # asymmetry grows with the drive, 20 dB a decade at least
    doubled = driver.play(2 * x, linear=True)
    np.testing.assert_allclose(doubled, 2 * driver.play(x, linear=True), atol=1e-9)  # float64 rounding


def echo_scene() -> tuple[np.ndarray, np.ndarray]:
    """mic and ref of 12 s in which the robot speaks alone, 25 ms late, over a decaying path of 60 ms."""
    ref = babble(12.0, 7)
    rng = np.random.default_rng(8)
    path = np.concatenate([np.zeros(400), [0.5], 0.1 * rng.standard_normal(1000) * np.exp(-np.arange(1000) / 200)])
    mic = np.convolve(ref, path)[: ref.size] + 1e-4 * rng.standard_normal(ref.size)
    return mic.astype(np.float32), ref


@pytest.mark.parametrize(
    ("peer", "least_db"), [(peers.speexdsp, 10.0), (peers.speexdsp_suppressed, 20.0), (peers.aec3, 20.0)]
)
def test_peer_cancels_an_echo_without_human(peer, least_db: float) -> None:
    mic, ref = echo_scene()
    out = peer(mic, ref)
    assert out.shape == mic.shape and out.dtype == np.float32
    last = slice(-4 * RATE, None)
    assert erle(mic[last], out[last]) > least_db  # a linear filter alone reaches less than one with suppression
    assert erle(mic[last], peer(mic, np.zeros_like(ref))[last]) < 3.0  # it is the reference that does it


@pytest.mark.parametrize("peer", [peers.speexdsp, peers.aec3])
def test_peer_output_is_aligned_with_the_input(peer) -> None:
    human = babble(6.0, 9)[: 6 * RATE - 77]
    out = peer(human, np.zeros_like(human))
    assert out.size == human.size
    lags = signal.correlate(out, human, "full")
    assert abs(int(np.argmax(lags)) - (human.size - 1)) <= 1  # a high-pass moves the peak by a fraction of a sample


def test_missing_library_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise OSError(name)

    monkeypatch.setattr(peers.ctypes, "CDLL", missing)
    with pytest.raises(UsageError, match="apt-get install libspeexdsp1"):
        peers.speexdsp(*echo_scene())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("Mr. O\u2019Neil, aged 42,", "mister o'neil aged forty two"),
        ("the 3rd of May 1839", "the third of may eighteen thirty nine"),
        ("1,200 men -- 'all' of them!", "one thousand two hundred men all of them"),
        ("the 20th in 2005", "the twentieth in two thousand five"),
    ],
)
def test_normalise(text: str, words: str) -> None:
    assert recogniser.normalise(text) == words


def test_word_errors_counts_and_cap() -> None:
    assert recogniser.word_errors("one two three four", "one too three") == recogniser.WordErrors(2, 4, deletions=1)
    assert recogniser.word_errors("Two words", "") == recogniser.WordErrors(2, 2, deletions=2)
    robot_heard = recogniser.word_errors("stop", "and then the robot went on")
    assert robot_heard.rate == 6.0 and robot_heard.capped == 1.0
    with pytest.raises(UsageError, match="no words"):
        recogniser.word_errors("...", "anything")


def test_recogniser_refuses_a_folder_without_model(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="holds no model.bin"):
        recogniser.Recogniser(tmp_path, tmp_path / "cache.jsonl")


def test_transcripts_are_kept_by_audio_and_survive_a_cut_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "model.bin").write_bytes(b"weights")
    (tmp_path / "config.json").write_text("{}")
    heard: list[float] = []

    def listen(self, samples: np.ndarray) -> str:
        heard.append(float(np.abs(samples).max()))
        return f"heard {len(heard)}"

    monkeypatch.setattr(recogniser.Recogniser, "_recognise", listen)
    cache = tmp_path / "kept" / "cache.jsonl"
    first, other = babble(0.5, 1), babble(0.5, 2)
    one = recogniser.Recogniser(tmp_path, cache)
    assert [one.transcribe(x) for x in (first, other, first)] == ["heard 1", "heard 2", "heard 1"]
    assert heard == pytest.approx([0.5, 0.5])  # every input is scaled to one peak
    assert one.transcribe(np.zeros(100, np.float32)) == ""
    cache.write_text(cache.read_text() + '{"key": "half')
    assert recogniser.Recogniser(tmp_path, cache).transcribe(other) == "heard 2" and len(heard) == 2


def test_a_real_recogniser_hears_the_human_where_the_robot_was(tmp_path: Path) -> None:
    """PocketSphinx on the bundled conversation: most words of the human alone, more of them filtered than unfiltered."""
    demo = Path(edgefilter.__file__).parent / "demo_data"
    mic, reference, human = (
        sf.read(demo / f"{name}.flac", dtype="float32")[0] for name in ("mic", "reference", "human")
    )
    filtered = edgefilter.enhance(mic, reference, edgefilter.Profile.load(demo / "profile.npz"), "ss")
    name, folder = recogniser.find_model("pocketsphinx")
    hears = recogniser.Recogniser(folder, tmp_path / "cache.jsonl")
    text = "please leave your message after the tone when done hang up or press the pound key"
    alone, with_robot, behind = (recogniser.word_errors(text, hears.transcribe(x)) for x in (human, mic, filtered))
    assert name == "pocketsphinx" and alone.rate < 0.6
    assert alone.errors < behind.errors < with_robot.errors


def test_summary_adds_up() -> None:
    found = [
        {"si_sdr": -2.0, "errors": 1, "words": 10, "seconds": 1.0, "duration": 10.0},
        {"si_sdr": 4.0, "errors": 9, "words": 3, "seconds": 1.0, "duration": 10.0},
        {"problem": "5 samples for 6", "seconds": 1.0, "duration": 10.0},
    ]
    row = scores.summarise(found)
    assert (row["utterances"], row["problems"], row["words"]) == (3, 1, 13)
    assert row["si_sdr_mean"] == row["si_sdr_median"] == pytest.approx(1.0) and row[
        "real_time_factor"
    ] == pytest.approx(0.1)
    assert (row["wer"], row["wer_mean"], row["wer_capped"]) == pytest.approx((1000 / 13, 155.0, 55.0))
    assert row["si_sdr_interval"] == pytest.approx((-2.0, 4.0))  # two utterances: the interval is their range
    assert "1 outputs unusable" in scores.markdown({"s": {"lab": {"ss": row}}})


def test_bootstrap_interval_has_the_width_of_the_standard_error() -> None:
    x = np.random.default_rng(5).standard_normal(400)
    low, high = intervals.interval(lambda sample: sample.mean(axis=1), x)
    assert high - low == pytest.approx(
        2 * 1.96 * x.std() / 20, rel=0.08
    )  # 2000 draws give a quantile to a few per cent
    assert intervals.interval(lambda sample: sample.mean(axis=1), x) == (low, high)


def run_quality(monkeypatch: pytest.MonkeyPatch, live: Path, output: Path, engines: str) -> tuple[int, dict]:
    arguments = [
        "quality.py",
        "--conversations",
        live,
        "--engines",
        engines,
        "--output",
        output,
        "--cache",
        output.parent / "cache",
    ]
    monkeypatch.setattr(sys, "argv", [str(argument) for argument in arguments])
    code = quality.main()
    return code, json.loads(output.with_suffix(".json").read_text()) if code == 0 else {}


def test_quality_scores_every_row(monkeypatch: pytest.MonkeyPatch, live: Path, tmp_path: Path) -> None:
    code, found = run_quality(
        monkeypatch, live, tmp_path / "q", "unfiltered,bypass,speexdsp,speexdsp-true-lag,linear,clean"
    )
    assert code == 0 and list(found["summary"]["live"]) == ["lab", "office"]
    for folder in live.iterdir():
        meta = json.loads((folder / "meta.json").read_text())
        rows = found["summary"]["live"][meta["room"]]
        assert not any(row["problems"] for row in rows.values())
        assert rows["unfiltered"]["si_sdr_mean"] == pytest.approx(
            meta["sisdr_mix"], abs=0.05
        )  # 16-bit rounding of the clean human
        assert rows["bypass"]["si_sdr_mean"] == pytest.approx(
            rows["unfiltered"]["si_sdr_mean"], abs=1e-3
        )  # float32 rounding
        assert "si_sdr_mean" not in rows["clean"]
        assert (
            rows["linear"]["si_sdr_mean"] > rows["unfiltered"]["si_sdr_mean"] + 5
        )  # the robot is 22-26 dB above the human
        assert rows["speexdsp-true-lag"]["si_sdr_mean"] != rows["speexdsp"]["si_sdr_mean"]
    assert "| linear |" in (tmp_path / "q.md").read_text()
    made_with = found["stamp"]
    assert (
        made_with["data"][0]["folder"] == "live" and made_with["data"][0]["files"] == 2 * 7 and not made_with["models"]
    )
    assert made_with["command"].startswith("python -m quality --conversations conversations/live --engines unfiltered,")


def test_true_lag_puts_both_utterances_where_they_are_heard(live: Path) -> None:
    for folder in sorted(live.iterdir()):
        talk = conversation.Conversation(folder)
        meta, mic, ref = talk.meta, talk.read("mic"), talk.delayed_reference()
        assert (
            abs(conversation.direct_delay(talk.read("sweep_ref"), talk.read("sweep_mic")) - meta["delay"]) <= 1
        )  # the fan
        drifting = np.interp(np.arange(ref.size) * (1 + meta["ppm"] * 1e-6), np.arange(ref.size), ref)
        onset = meta["t_main"] + meta["lag2"]
        for part in (slice(0, meta["t_main"]), slice(onset, meta["end"])):
            # half a sample for rounding of the lag, half for the loudspeaker's distortion
            assert lag_between(mic[part], drifting[part]) == pytest.approx(conversation.MARGIN, abs=1)


def test_unusable_output_is_counted_not_scored(monkeypatch: pytest.MonkeyPatch, live: Path, tmp_path: Path) -> None:
    monkeypatch.setattr(quality.peers, "speexdsp", lambda mic, ref: mic[:-1])
    monkeypatch.setattr(quality.peers, "aec3", lambda mic, ref: np.full_like(mic, np.nan))
    _, found = run_quality(monkeypatch, live, tmp_path / "q", "speexdsp,aec3")
    problems = {row["engine"]: row["problem"] for row in found["utterances"]}
    assert problems["aec3"] == "samples that are not finite" and "samples for" in problems["speexdsp"]
    assert found["summary"]["live"]["lab"]["aec3"] == {"utterances": 1, "problems": 1}


def test_scores_are_not_made_twice(monkeypatch: pytest.MonkeyPatch, live: Path, tmp_path: Path) -> None:
    _, before = run_quality(monkeypatch, live, tmp_path / "q", "speexdsp")
    monkeypatch.setattr(quality, "score", lambda *arguments: pytest.fail("a kept score was made again"))
    _, after = run_quality(monkeypatch, live, tmp_path / "q", "speexdsp")
    assert before["utterances"] == after["utterances"]


def test_folder_without_conversations_is_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _ = run_quality(monkeypatch, tmp_path, tmp_path / "q", "clean")
    assert code == 1 and "holds no */meta.json" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("before", "after", "delay", "shown"),
    [(None, 0.1, 100.0, "2 of 2 | 0 | 0"), (0.5, None, 0.0, "1 of 1 | 1 | 0"), (None, None, None, "1 of 2 | 0 | 1")],
)
def test_barge_in_counts_from_the_humans_first_sound(
    live: Path, monkeypatch: pytest.MonkeyPatch, before, after, delay, shown
) -> None:
    talk = conversation.find_conversations([live])["live"][0]
    power = levels.frame_power(talk.read("clean"))
    onset = int(np.flatnonzero(power > 10**-2.5 * power.max())[0]) * levels.FRAME
    said = [] if before is None else [Event("speech_started", onset - int(before * RATE), "")]
    said += [] if after is None else [Event("speech_started", onset + int(after * RATE), "")]
    heard = []
    late = [0.0] * (onset // 160 + 10) + [0.93]
    answers = iter(
        [
            lambda mic: heard.append(mic) or (said, late, 160),
            lambda mic: heard.append(mic) or ([Event("speech_started", 5, "")] * 3, [0.75], 160),
        ]
    )
    monkeypatch.setattr(
        barge_in,
        "talk",
        lambda talk, mic: barge_in.Talk(*next(answers)(mic)),
    )
    row = barge_in.measure(talk)
    assert row["delay_ms"] == delay and row["early"] == (before is not None) and row["alarms"] == 3
    np.testing.assert_array_equal(heard[1], talk.read("mic") - talk.read("clean"))
    text = barge_in.markdown([{"set": "live", **row}, {"set": "live", **row, "delay_ms": 50.0, "early": False}])
    assert f"| {shown} | 6 in " in text
    hours = 2 * row["seconds"] / 3600
    assert f"| 0.7 | 100 | {2 / hours:.0f} |" in text and "| 0.9 | 100 | 0 |" in text and "| 0.94 | 0 | 0 |" in text


def test_a_row_is_scored_anew_where_its_code_or_its_network_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tree = tmp_path / "edgefilter"
    shutil.copytree(Path(quality.edgefilter.__file__).parent, tree)
    (tmp_path / "models").mkdir()
    (tmp_path / "models/crnn_int8.onnx").touch()
    monkeypatch.setattr(quality.edgefilter, "__file__", str(tree / "__init__.py"))

    def versions() -> list[str]:
        return [quality.code_version(name) for name in ("aec3", "ss", "crnn")]

    def changed_by(path: Path) -> list[bool]:
        before = versions()
        path.write_bytes(path.read_bytes() + b"\n")
        return [a != b for a, b in zip(before, versions(), strict=True)]

    assert changed_by(tmp_path / "models/crnn_int8.onnx") == [False, False, True]
    assert changed_by(tree / "filter/canceller.py") == [False, True, True]
    assert changed_by(tree / "engines/spectral_subtraction.py") == [False, True, True]  # crnn gives it a share
    assert changed_by(tree / "engines/onnx_session.py") == [False, False, True]
    assert changed_by(tree / "diagnosis/diagnose.py") == [False, False, False]
