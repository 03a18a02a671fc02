"""What an agent's clock does to its speech, and what of it becomes the filter's reference."""

import threading

import numpy as np
import pytest
import soxr

from edgefilter import EgoFilter, SignalError, UsageError
from edgefilter.dsp.resample import Resampler
from edgefilter.integrations import duplex as module
from edgefilter.integrations.duplex import Duplex, Pace, as_pcm16, from_pcm16
from edgefilter.integrations.turns import TurnByTurn
from edgefilter.types import SAMPLE_RATE as RATE
from edgefilter.types import Event, Turn
from tests.program import demo

VOICE = 0.1 * np.random.default_rng(0).standard_normal(2 * RATE).astype(np.float32)


class Witness:
    """In the filter's place: gives the microphone back and keeps the reference that it got."""

    waits_for_end = False
    engine_name = "witness"
    speech_probability: float | None = 0.0

    def __init__(self):
        self.references = [np.zeros(0, np.float32)]
        self.happened = []

    @property
    def reference(self):
        return np.concatenate(self.references)

    def process(self, mic, reference):
        assert len(mic) == reference.size
        self.references.append(reference)
        return mic if mic.ndim == 1 else mic[:, 0]

    def events(self):
        return list(self.happened)


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def witness():
    return Witness()


@pytest.mark.parametrize("rate", [RATE, 48_000])
def test_sound_of_another_kind_is_refused_as_the_filter_does_and_a_column_is_a_channel(witness, rate):
    """16-bit samples were taken for samples 90 dB louder, a column of them ended the next hop in an error of numpy."""
    duplex, frame = Duplex(witness), VOICE[:480]
    wrong = {
        "dtype int16, expected float": (32767 * frame).astype(np.int16),
        r"dtype uint8, .*numpy.frombuffer\(buffer, numpy.float32\)": memoryview(bytes(960)),  # as RawInputStream has it
        "dtype .S3.*frombuffer": b"abc",
        "holds nan": np.full(480, np.nan, np.float32),
    }
    for words, samples in wrong.items():
        for take, name in ((duplex.play, "speech"), (duplex.hear, "mic")):
            with pytest.raises(SignalError, match=f"{name} (has )?{words}"):
                take(samples, rate)
    with pytest.raises(SignalError, match=r"speech has shape \(480, 2\), expected"):
        duplex.play(np.stack((frame, frame), axis=1), rate)
    assert duplex.queued_s == 0 and duplex.heard == 0
    columns, row = Duplex(Witness()), duplex
    for each, shape in ((columns, (-1, 1)), (row, (-1,))):
        each.play(VOICE[:RATE].reshape(shape), rate)
    heard = [each.hear(VOICE[:4800].reshape(shape), rate) for each, shape in ((columns, (-1, 1)), (row, (-1,)))]
    assert heard[0].size > 1000 and np.array_equal(*heard)
    assert row.ego.reference.any() and np.array_equal(columns.ego.reference, row.ego.reference)


def listen(duplex, seconds, rate=RATE, frame=320):
    """Let seconds pass at the microphone; how much of them came out."""
    total = round(seconds * rate)
    return sum(duplex.hear(np.zeros(min(frame, total - at), np.float32), rate).size for at in range(0, total, frame))


@pytest.mark.parametrize("frames", [(160, 160), (320, 640), (1, 977), (65536, 3)], ids=str)
def test_speech_that_is_handed_over_at_once_is_the_reference_at_the_pace_of_the_microphone(witness, frames):
    duplex = Duplex(witness)
    duplex.play(VOICE, RATE)
    for count in frames * 2:
        duplex.hear(np.zeros(count, np.float32), RATE)
    heard = 2 * sum(frames)
    np.testing.assert_array_equal(witness.reference[: VOICE.size], VOICE[:heard])
    assert not witness.reference[VOICE.size :].any() and witness.reference.size == heard


def test_a_caller_may_use_its_buffers_again_while_what_they_held_still_waits(witness):
    """As audio callbacks do; at 16 kHz the next frame was in the place of all that waited."""
    duplex, speech, heard, out = Duplex(witness), np.empty(160, np.float32), np.empty(480, np.float32), []
    for at in range(0, 4800, 160):
        speech[:] = VOICE[at : at + 160]
        duplex.play(speech, RATE)
    for at in range(0, 9600, 480):
        heard[:] = -VOICE[at : at + 480]
        out.append(duplex.hear(heard, RATE).copy())
    np.testing.assert_array_equal(witness.reference[:4800], VOICE[:4800])
    np.testing.assert_array_equal(np.concatenate(out), -VOICE[:9600])


def test_speech_cut_off_in_mid_word_was_not_played_and_the_next_begins_at_once(witness):
    duplex = Duplex(witness)
    duplex.play(VOICE, RATE)
    listen(duplex, 0.5)
    duplex.interrupt()
    listen(duplex, 0.25)
    duplex.play(VOICE[::-1], RATE)
    listen(duplex, 0.25)
    expected = np.concatenate((VOICE[: RATE // 2], np.zeros(RATE // 4), VOICE[::-1][: RATE // 4]))
    np.testing.assert_array_equal(witness.reference, expected.astype(np.float32))
    assert duplex.stats()["dropped_s"] == 1.5


@pytest.mark.parametrize("channels", [1, 2])
def test_speech_is_lowered_while_the_filter_asks_for_it_and_the_filter_knows_what_waits(witness, channels):
    duplex, said = Duplex(witness), np.full(1600, 0.4, np.float32)
    for gain, last in ((1.0, 0.4), (0.25, 0.1), (1.0, 0.4)):
        witness.voice_gain = gain
        pcm = duplex.lowered_pcm16(as_pcm16(said, channels), RATE, channels)
        sound = from_pcm16(pcm, channels)
        assert sound[-1] == pytest.approx(last, abs=1e-4) and np.abs(np.diff(sound)).max() < 0.01
        duplex.play_pcm16(pcm, RATE, channels)
    duplex.hear(np.zeros(800, np.float32), RATE)
    assert witness.queued_s == pytest.approx(0.25)
    duplex.hear(np.zeros(4000, np.float32), RATE)
    assert witness.reference[2400] == pytest.approx(0.1, abs=1e-4)


def test_speech_that_ran_out_leaves_a_gap_as_long_as_the_loudspeaker_was_silent(witness):
    duplex = Duplex(witness, patience_s=0)
    duplex.play(VOICE[:3200], RATE)
    listen(duplex, 0.3)
    duplex.play(VOICE[3200:6400], RATE)
    listen(duplex, 0.3)
    np.testing.assert_array_equal(witness.reference[:3200], VOICE[:3200])
    assert not witness.reference[3200:4800].any() and duplex.stats()["gaps"] == 2
    np.testing.assert_array_equal(witness.reference[4800:8000], VOICE[3200:6400])


def test_a_frame_that_is_late_is_waited_for_and_leaves_no_gap(witness):
    duplex = Duplex(witness, patience_s=0.1)
    duplex.play(VOICE[:1280], RATE)
    assert listen(duplex, 0.16) == 1280, "0.08 s were there, as many wait"
    duplex.play(VOICE[1280:3840], RATE)
    assert listen(duplex, 0.02) == 1280 + 320
    np.testing.assert_array_equal(witness.reference, VOICE[:2880])


def test_one_frame_that_is_20_ms_late_makes_no_gap_unless_asked_for(witness):
    """A gap that the loudspeaker did not make moves the reference by 20 ms: 17 dB less until it is aligned again."""
    for count, patience in ((320, {}), (0, {"patience_s": 0.0})):
        duplex = Duplex(witness, **patience)
        duplex.play(VOICE[:3200], RATE)
        listen(duplex, 0.22)
        duplex.play(VOICE[3200:6400], RATE)
        listen(duplex, 0.1)
        np.testing.assert_array_equal(witness.reference[-320:], VOICE[4800 + count - 320 : 4800 + count])


def test_the_microphone_waits_no_longer_than_its_patience_and_loses_nothing(witness):
    duplex = Duplex(witness, patience_s=0.1)
    duplex.play(VOICE[:1280], RATE)
    assert listen(duplex, 0.18) == 1280 and listen(duplex, 0.02) == 1920, "0.12 s are more than 0.1 s"
    assert listen(duplex, 1.0) == RATE, "after the gap nobody waits"
    np.testing.assert_array_equal(witness.reference[:1280], VOICE[:1280])


def test_an_utterance_that_was_ended_is_not_waited_for(witness):
    duplex = Duplex(witness, patience_s=0.1)
    duplex.play(VOICE[:1280], RATE)
    duplex.end()
    assert listen(duplex, 0.2) == 3200


@pytest.mark.parametrize("said, heard", [(24000, 16000), (22050, 48000), (8000, 44100), (48000, 8000)])
def test_rates_of_speech_and_microphone_may_be_any(witness, said, heard):
    duplex = Duplex(witness)
    voice = soxr.resample(soxr.resample(VOICE, RATE, 6000), 6000, said)  # nothing that 8 kHz could not carry
    for at in range(0, voice.size, 441):
        duplex.play(voice[at : at + 441], said)
    duplex.end()
    out = listen(duplex, 2.5, heard, frame=heard // 100)
    assert 2.5 * heard >= out > 2.2 * heard, "what the resamplers hold back, 0.23 s for the two of 8 kHz"
    expected = soxr.resample(voice, said, RATE)
    error = witness.reference[: expected.size][800:-800] - expected[800:-800]
    assert np.mean(error**2) < 1e-4 * np.mean(expected**2), "40 dB: two resamplers, of which one ran in pieces"


def test_what_was_played_while_the_microphone_was_off_is_not_heard_later(witness):
    clock = Clock()
    duplex = Duplex(witness, clock=clock)
    duplex.play(np.tile(VOICE, 5), RATE)
    for _ in range(50):
        clock.now += 0.02
        listen(duplex, 0.02)
    clock.now += 5.0  # muted for 5 s
    for _ in range(2):
        clock.now += 0.02
        listen(duplex, 0.02)
    assert duplex.stats()["unheard_s"] == pytest.approx(5.0, abs=0.01)
    np.testing.assert_array_equal(witness.reference[-640:], np.tile(VOICE, 5)[6 * RATE : 6 * RATE + 640])


def test_a_microphone_that_comes_in_bursts_loses_no_reference(witness):
    clock = Clock()
    duplex = Duplex(witness, clock=clock)
    duplex.play(VOICE, RATE)
    for _ in range(2):
        clock.now += 0.8  # the event loop stood still
        listen(duplex, 0.8)
    np.testing.assert_array_equal(witness.reference, VOICE[: 8 * RATE // 5])


SAID = np.arange(1, 10 * RATE + 1, dtype=np.float32) / 2**18
"""10 s, of which each sample tells its place."""


def heard_by(duplex, clock, frames):
    """Let frames come to the microphone, each (when it comes, s; its first sample); where the reference of each was taken."""
    ego = duplex.ego
    at = []
    for now, sample in frames:
        clock.now = now
        before = ego.reference.size
        duplex.hear(np.zeros(320, np.float32), RATE)
        came = ego.reference[before:][-320:]
        at.append(round(float(came[0]) * 2**18) - 1 - sample if came.size else None)
    return at


def talking(witness):
    clock = Clock()
    duplex = Duplex(witness, clock=clock)
    duplex.play(SAID, RATE)
    return duplex, clock


def test_a_hole_in_the_microphone_s_sound_is_followed_within_a_tenth_of_a_second_and_nothing_is_paired_wrongly(witness):
    """A driver's overrun of 0.2 s; until the utterance ended the robot was not removed."""
    duplex, clock = talking(witness)
    frames = [(0.02 * k + 0.02, 320 * k) for k in range(90) if not 40 <= k < 50]
    shift = heard_by(duplex, clock, frames)
    assert set(shift[:40]) == {0}
    assert set(shift[40:45]) <= {None, 0} and set(shift[45:]) == {0}, "held back, then where it belongs"
    assert duplex.stats()["unheard_s"] == pytest.approx(0.2, abs=1e-3)


def test_twenty_milliseconds_lost_each_second_are_followed(witness):
    duplex, clock = talking(witness)
    frames = [(0.02 * k + 0.02, 320 * k) for k in range(400) if k % 50 != 49]
    shift = heard_by(duplex, clock, frames)
    assert all(shift[49 * n + 7 : 49 * n + 49] == [0] * 42 for n in range(8)), "0.14 s after each loss"
    assert duplex.stats()["unheard_s"] == pytest.approx(7 * 0.02, abs=1e-3)


@pytest.mark.parametrize("stall", [0.03, 0.1, 0.3, 0.9])
def test_a_loop_that_stood_still_and_finds_all_of_it_waiting_has_lost_nothing(witness, stall):
    duplex, clock = talking(witness)
    frames = [(max(0.02 * k + 0.02, 1.0 + stall if k >= 50 else 0.0), 320 * k) for k in range(120)]
    shift = heard_by(duplex, clock, frames)
    wrong = [at for at in shift if at not in (0, None)]
    assert len(wrong) <= 1 and shift[-20:] == [0] * 20
    assert duplex.stats()["unheard_s"] == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("together", [2, 5])
def test_frames_that_come_several_at_once_are_no_loss(witness, together):
    duplex, clock = talking(witness)
    rng = np.random.default_rng(0)
    frames = [(0.02 * together * (k // together + 1) + rng.uniform(0, 0.005), 320 * k) for k in range(300)]
    assert set(heard_by(duplex, clock, frames)) == {0} and duplex.stats()["unheard_s"] == 0


@pytest.mark.parametrize("ppm", [-300, 300])
def test_a_clock_that_differs_is_no_loss(witness, ppm):
    duplex, clock = talking(witness)
    frames = [((0.02 * k + 0.02) * (1 + 1e-6 * ppm), 320 * k) for k in range(450)]
    assert set(heard_by(duplex, clock, frames)) == {0} and duplex.stats()["unheard_s"] == 0


def test_sound_that_comes_after_all_is_paired_as_if_it_had_come_in_time(witness):
    """Late by 0.2 s for half a second: taken for lost, until all of it comes at once."""
    duplex, clock = talking(witness)
    late = {k: 0.02 * k + 0.22 for k in range(50, 75)} | {k: 1.7 + 1e-4 * k for k in range(75, 85)}
    shift = heard_by(duplex, clock, [(late.get(k, 0.02 * k + 0.02), 320 * k) for k in range(140)])
    assert shift[-40:] == [0] * 40 and duplex.stats()["unheard_s"] == pytest.approx(0.0, abs=2e-3)


def test_a_loss_shows_at_once_in_frames_that_carry_their_time(witness):
    duplex, clock = talking(witness)
    for k in [*range(40), *range(55, 80)]:
        clock.now = 1.0 + 0.02 * k
        duplex.hear(np.zeros(320, np.float32), RATE, at_s=0.02 * k)
    assert duplex.stats()["unheard_s"] == pytest.approx(0.3, abs=1e-3)
    np.testing.assert_array_equal(witness.reference, SAID[: 80 * 320])  # the filter gets what was lost, too


@pytest.mark.slow
def test_a_robot_is_removed_though_the_microphone_lost_a_fifth_of_a_second_of_it(room_of):
    """What was lost of its reference is still to be heard then, for as long as the lag: it passed, and was taken for a human."""
    mic, ref = demo("mic", "reference")
    clock = Clock()
    duplex, out, happened = Duplex(EgoFilter(room_of.PROFILE, engine="crnn"), clock=clock), [], []
    for at in range(0, 6 * RATE, 320):
        clock.now = (at + 320) / RATE
        duplex.play(ref[at : at + 320], RATE)
        if not 3.0 <= at / RATE < 3.2:
            out.append(duplex.hear(mic[at : at + 320], RATE))
        happened += duplex.events()
    human = np.concatenate(out)
    assert 0 <= round(5.8 * RATE) - human.size <= duplex.ego.latency
    human, heard = human[3 * RATE :], mic[round(3.2 * RATE) : 6 * RATE]
    assert 10 * np.log10(np.mean(heard**2) / np.mean(human**2)) > 20.0
    assert not {event.kind for event in happened} & {"reference_late", "echo_unpredicted", "speech_started"}


def test_a_paused_loudspeaker_goes_on_where_it_stopped_but_for_what_it_threw_away(witness):
    duplex = Duplex(witness)
    duplex.play(VOICE, RATE)
    listen(duplex, 0.5)
    duplex.pause()
    listen(duplex, 0.5)
    duplex.resume(skipped_s=0.2)
    listen(duplex, 0.5)
    assert not witness.reference[RATE // 2 : RATE].any()
    np.testing.assert_array_equal(witness.reference[RATE:], VOICE[11200:19200])


def test_a_loudspeaker_that_is_paused_while_the_microphone_is_off_plays_nothing_meanwhile(witness):
    clock = Clock()
    duplex = Duplex(witness, clock=clock)
    duplex.play(VOICE, RATE)
    listen(duplex, 0.5)
    duplex.pause()
    clock.now += 5.0
    listen(duplex, 0.1)
    duplex.resume()
    listen(duplex, 0.5)
    assert duplex.stats()["unheard_s"] == 0
    np.testing.assert_array_equal(witness.reference[-RATE // 2 :], VOICE[RATE // 2 : RATE])


def test_the_queue_is_bounded_and_says_what_it_refused(witness, monkeypatch):
    monkeypatch.setattr(module, "MOST_QUEUED_S", 1.5)
    duplex = Duplex(witness)
    for _ in range(3):
        duplex.play(VOICE, RATE)
    assert duplex.queued_s == 1.5 and duplex.stats()["refused_s"] == 4.5


def test_switched_off_it_passes_the_microphone_and_the_filter_still_knows_what_is_played(witness):
    duplex = Duplex(witness)
    duplex.play(VOICE, RATE)
    duplex.enabled = False
    assert duplex.hear(VOICE[:RATE], RATE) is not None and (duplex.hear(VOICE[:320], RATE) == VOICE[:320]).all()
    duplex.enabled = True
    listen(duplex, 0.1)
    np.testing.assert_array_equal(witness.reference[-1600:], VOICE[RATE + 320 : RATE + 1920])


def test_an_engine_that_judges_no_speech_is_told_of_once_and_so_is_its_end(witness, caplog):
    duplex = Duplex(witness)
    for probability in (0.1, None, None, 0.2):
        witness.speech_probability = probability
        listen(duplex, 0.1)
    told = [record.getMessage() for record in caplog.records]
    assert len(told) == 2 and "witness detects no speech: the human is not noticed" in told[0]
    assert "noticed again" in told[1]


def test_a_filter_that_steps_down_to_an_engine_that_judges_no_speech_says_so(caplog):
    ego = EgoFilter(budget_ms=1e-6)
    assert not ego.judges_speech
    listen(Duplex(ego), 1.0)
    assert "detects no speech: the human is not noticed" in caplog.text


@pytest.mark.parametrize(
    ("factor", "words"),
    [(3.0, "brings 48000 samples a second and is said to have 16000"), (2.0, "32000"), (1.0, ""), (1.7, ""), (0.5, "8000")],
    ids=["48 kHz as 16", "stereo as mono", "right", "a file", "8 kHz as 16"],
)  # fmt: skip
def test_a_rate_or_channels_that_are_not_the_microphone_s_are_said_once(witness, caplog, factor, words):
    clock = Clock()
    duplex = Duplex(witness, clock=clock)
    for _ in range(1500):
        clock.now += 0.02
        duplex.hear(np.zeros(round(320 * factor), np.float32), RATE)
    wrong = [event for event in duplex.events() if event.kind == "rate_mismatch"]
    assert len(wrong) == bool(words) and duplex.events() == []
    assert all(words in event.detail for event in wrong) and caplog.text.count("rate mismatch") == bool(words)


def test_an_agent_whose_reference_is_late_does_not_interrupt_itself_and_the_log_says_why(room_of, caplog):
    room, events = room_of.Room(), []
    duplex = Duplex(EgoFilter(room_of.PROFILE, engine="crnn"), on_event=events.append)
    room.play(room_of.ROBOT)
    for step in range(250):
        if step == 20:  # 0.4 s after the loudspeaker
            duplex.play(room_of.ROBOT, RATE)
        duplex.hear(room.hear(320), RATE)
    besides = ("realigned", "overloaded")  # the latter where other tests keep the machine busy
    assert [event.kind for event in events if event.kind not in besides] == ["reference_late"]
    assert "reference late: the reference comes" in caplog.text


def test_events_that_nobody_asks_for_hold_the_sound_of_the_latest_ten_minutes(witness):
    duplex, minute = Duplex(witness), np.zeros(60 * RATE, np.float32)
    for number in range(13):
        witness.happened = [Event("speech_stopped", number, "", Turn(0, minute))]
        listen(duplex, 0.02)
    assert [event.turn is not None for event in duplex.events()] == [False] * 3 + [True] * 10


def test_the_filter_that_it_makes_itself_judges_speech():
    assert Duplex().ego.judges_speech


def test_speech_may_come_from_another_thread(witness):
    duplex = Duplex(witness)

    def talk():
        for at in range(0, VOICE.size, 64):
            duplex.play(VOICE[at : at + 64], RATE)

    thread = threading.Thread(target=talk)
    thread.start()
    while thread.is_alive():
        duplex.hear(np.zeros(32, np.float32), RATE)
    listen(duplex, 2.0)
    np.testing.assert_array_equal(witness.reference[witness.reference != 0], VOICE[VOICE != 0])


def test_an_engine_that_answers_at_the_end_is_refused(witness):
    witness.waits_for_end = True
    with pytest.raises(UsageError, match="witness needs the whole recording"):
        Duplex(witness)


def test_bytes_become_one_channel_and_back():
    stereo = np.array([[16384, 0], [-32768, -32768]], "<i2")
    np.testing.assert_array_equal(from_pcm16(stereo.tobytes(), 2), np.float32([0.25, -1.0]))
    assert as_pcm16(np.float32([0.5, 2.0]), 2) == np.array([16384, 16384, 32767, 32767], "<i2").tobytes()
    with pytest.raises(SignalError, match="found 3 bytes, expected whole 16-bit samples of 1"):
        from_pcm16(b"abc")


def test_the_robot_is_removed_though_its_speech_comes_in_bursts_is_cut_off_and_begins_again(room_of):
    """At other rates than the filter's; the loudspeaker drops what it holds when the speech is cut off."""
    room = room_of.Room()
    events, step = [], 0
    duplex = Duplex(EgoFilter(room_of.PROFILE, engine="crnn"), on_event=events.append, clock=lambda: 0.02 * step)
    heard, filtered = [], []
    for step in range(300):
        if step in (0, 150):
            duplex.play(soxr.resample(room_of.ROBOT, RATE, 24000), 24000)
            room.play(room_of.ROBOT)
        if step == 100:
            duplex.interrupt()
            room.silence()
        heard.append(room.hear(320))
        filtered.append(duplex.hear(heard[-1], RATE))
    mic, out = np.concatenate(heard), np.concatenate(filtered)
    for start, end in ((0.5, 2.2), (3.5, 5.9)):
        part = slice(round(start * RATE), round(end * RATE))
        assert 10 * np.log10(np.mean(out[part] ** 2) / np.mean(mic[part] ** 2)) < -25  # 44 dB were seen
    assert np.abs(out).max() < 1.12 * np.abs(mic).max()  # 1 dB
    assert not [event for event in events if event.kind == "speech_started"], "nobody spoke"


@pytest.mark.parametrize("rate", [RATE, 48000])
def test_an_array_goes_through_to_the_filter_and_one_channel_comes_back(rate):
    frame = np.zeros((rate // 50, 3), np.float32)
    frame[:, 1] = 0.1
    duplex = Duplex(EgoFilter(engine="linear"))
    heard = [duplex.hear(frame, rate) for _ in range(50)]
    assert all(part.ndim == 1 for part in heard) and duplex.ego.stats()["array"]["microphones"] == 3
    assert sum(part.size for part in heard) == pytest.approx(rate, abs=0.13 * rate)
    duplex.enabled = False
    assert np.array_equal(duplex.hear(frame, rate), frame[:, 0])


def test_named_channels_are_an_array_and_others_are_not_heard(pair):
    profile, sound = pair
    duplex = Duplex(EgoFilter(profile, engine="linear"), mic_channels=[1, 2])
    alone = EgoFilter(profile, engine="linear")
    pcm = np.rint(sound[:RATE] * 32768).astype("<i2")
    out = from_pcm16(duplex.hear_pcm16(pcm.tobytes(), RATE, 3), 3)
    assert duplex.ego.stats()["array"]["microphones"] == 2
    expected = alone.process(pcm[:, 1:].astype(np.float32) / 32768, np.zeros(RATE, np.float32))
    np.testing.assert_allclose(out, expected, atol=1 / 32768)
    one = from_pcm16(duplex.hear_pcm16(pcm.tobytes(), RATE, 3, 1))
    assert RATE <= one.size < RATE + 256, "one channel where it is asked for"


def test_the_channel_that_is_named_first_is_what_is_heard_of_it():
    duplex = Duplex(EgoFilter(engine="bypass"), mic_channels=[2])
    sound = np.stack((0 * VOICE, 0 * VOICE, VOICE), axis=1)
    out = duplex.hear(sound, RATE)
    np.testing.assert_allclose(out, VOICE[: out.size], atol=1e-6)
    duplex.enabled = False
    np.testing.assert_array_equal(duplex.hear(sound, RATE), VOICE)


def test_channels_that_are_not_there_are_one_line():
    with pytest.raises(SignalError, match="has 2 channels, 0 to 1, found channel 2 asked for: choose others"):
        Duplex(EgoFilter(engine="bypass"), mic_channels=[0, 2]).hear_pcm16(bytes(40), RATE, 2)
    for wrong in ([], [1, 1], [-1, 0], range(9)):
        with pytest.raises(UsageError, match="expected the numbers of one to 8 different channels, from 0"):
            Duplex(EgoFilter(engine="bypass"), mic_channels=wrong)


@pytest.mark.parametrize("rate", [RATE, 48_000])
@pytest.mark.parametrize("mics", [[1], [2, 1]])
def test_a_channel_of_the_device_is_the_reference_and_what_is_said_is_none(witness, rate, mics):
    duplex, heard = Duplex(witness, mic_channels=mics, reference_channel=0), []
    duplex.play(VOICE, RATE)
    sound = 0.1 * np.random.default_rng(1).standard_normal((rate // 2, 3)).astype(np.float32)
    for at in range(0, len(sound), 333):
        heard.append(duplex.hear(sound[at : at + 333], rate))
    expected = Resampler(rate, RATE).push(sound[:, 0])
    np.testing.assert_allclose(witness.reference, expected, atol=1e-6)
    assert duplex.queued_s == pytest.approx(2.0 - expected.size / RATE), "what is said is still paced by the microphone"
    if rate == RATE and len(mics) == 1:
        np.testing.assert_array_equal(np.concatenate(heard), sound[:, 1])


def test_an_array_with_a_loopback_beside_it_does_what_the_filter_does_with_both(talking):
    profile, sound = talking
    duplex = Duplex(EgoFilter(profile, engine="linear"), mic_channels=[1, 2], reference_channel=0)
    pcm = np.rint(sound * 32768).astype("<i2")
    out = np.concatenate(
        [from_pcm16(duplex.hear_pcm16(pcm[at : at + 320].tobytes(), RATE, 3, 1)) for at in range(0, len(pcm), 320)]
    )
    both = pcm.astype(np.float32) / 32768
    expected = EgoFilter(profile, engine="linear").process(both[:, 1:], both[:, 0])
    np.testing.assert_allclose(out, expected, atol=1 / 32768)
    part = slice(RATE, 2 * RATE)
    assert np.mean(out[part] ** 2) < 0.01 * np.mean(both[part, 1] ** 2), "the robot alone"


def test_a_reference_channel_that_cannot_be_one_is_one_line():
    for wrong, mics in ((0, [1, 0]), (-1, [1])):
        with pytest.raises(UsageError, match=f"reference_channel is {wrong}, expected a channel, from 0, beside"):
            Duplex(EgoFilter(engine="bypass"), mic_channels=mics, reference_channel=wrong)
    with pytest.raises(UsageError, match="reference_channel is 5, expected mic_channels that name the others"):
        Duplex(EgoFilter(engine="bypass"), reference_channel=5)
    with pytest.raises(SignalError, match="has 2 channels, 0 to 1, found channel 5 asked for"):
        Duplex(EgoFilter(engine="bypass"), mic_channels=[0], reference_channel=5).hear_pcm16(bytes(40), RATE, 2)


def test_that_channels_are_averaged_is_said_once(caplog):
    duplex = Duplex(EgoFilter(engine="bypass"))
    for _ in range(2):
        duplex.hear_pcm16(bytes(400), RATE, 2)
    assert caplog.text.count("2 channels averaged to one") == 1 and "mic_channels" in caplog.text


@pytest.mark.slow
@pytest.mark.parametrize("rate", [16_000, 48_000])
def test_a_recogniser_gets_the_finished_turn_and_where_there_is_none_what_was_streamed(pair, rate):
    profile, sound = pair
    ended = []
    duplex = Duplex(EgoFilter(profile, engine="crnn"), on_event=ended.append, mic_channels=[1, 2])
    turns, hop = TurnByTurn(duplex), 320
    turns.start()
    for at in range(0, len(sound), hop):
        human = duplex.hear(sound[at : at + hop], RATE)
        turns.hear(np.repeat(human, rate // RATE), rate)
    (turn,) = [event.turn for event in ended if event.turn]
    taken, its_rate = turns.take()
    assert its_rate == rate and taken.size == turn.samples.size * rate // RATE
    assert duplex.heard == len(sound)
    if rate == RATE:
        np.testing.assert_array_equal(taken, turn.samples)
    duplex.enabled = False
    turns.start()
    streamed = [duplex.hear(sound[at : at + hop], RATE) for at in range(0, len(sound), hop)]
    for part in streamed:
        turns.hear(part, RATE)
    np.testing.assert_array_equal(turns.take()[0], np.concatenate(streamed))


def test_of_a_turn_only_what_belongs_to_the_recogniser_s_is_taken(pair):
    profile, sound = pair
    duplex = Duplex(EgoFilter(profile, engine="crnn"), mic_channels=[1, 2])
    turns = TurnByTurn(duplex)
    duplex.hear(sound[:24_000], RATE)
    turns.start(duplex.heard)
    duplex.hear(sound[24_000:], RATE)
    (turn,) = [event.turn for event in duplex.events() if event.turn]
    taken, _ = turns.take()
    assert turn.start < 24_000 and taken.size == turn.start + turn.samples.size - 24_000
    turns.close()
    assert duplex.listeners == []


def test_of_what_was_streamed_half_a_second_before_the_turn_and_30_s_of_it_are_kept_and_nothing_twice():
    turns, other = (TurnByTurn(Duplex(EgoFilter(engine="bypass"))) for _ in range(2))
    nothing, rate = other.take()
    assert nothing.size == 0 and rate == RATE
    rate = 1000
    parts = [np.full(500, at, np.float32) for at in range(64)]
    for _ in range(2):
        for part in parts[:3]:
            turns.hear(part, rate)
        turns.start()
        turns.hear(parts[3], rate)
        taken, its_rate = turns.take()
        assert its_rate == rate
        # the part that the half second ends in is kept as a whole
        np.testing.assert_array_equal(taken, np.concatenate(parts[1:4]))
    turns.start()
    for part in parts:
        turns.hear(part, rate)
    np.testing.assert_array_equal(turns.take()[0], np.concatenate(parts[-61:]))


def said_of(rate, seconds):
    """What is said of a stream that brings so many samples in each second, and is said to have that rate."""
    now = iter(range(1000))
    pace = Pace(lambda: float(next(now)))
    return [said for said in (pace.note(samples, rate) for samples in seconds) if said]


@pytest.mark.parametrize(
    ("rate", "brings"),
    [
        *((48_000, brings) for brings in (8000, 16_000, 24_000, 44_100)),
        *((16_000, brings) for brings in (24_000, 32_000, 44_100, 48_000)),
        *((8000, brings) for brings in (32_000, 48_000)),
        (24_000, 16_000),
        (44_100, 48_000),
    ],
)
def test_sound_that_comes_at_the_pace_of_another_rate_or_of_more_channels_is_said_once(rate, brings):
    (said,) = said_of(rate, [brings] * 40)
    assert f"brings {brings} samples a second and is said to have {rate}" in said


@pytest.mark.parametrize("brings", [[16_000], [31_600], [32_400], [20_000], [32_000] * 5 + [33_000] * 5])
def test_a_pace_that_no_wrong_rate_explains_or_that_wavers_is_not_said(brings):
    """The first second came before, so that its sum counts nowhere."""
    assert not said_of(16_000, [16_000, *brings * (40 // len(brings))])
