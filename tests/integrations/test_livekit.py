"""Against the real LiveKit Agents: its session, its outputs, its audio streams; no server."""

import asyncio

import numpy as np
import pytest

from edgefilter import EgoFilter, UsageError
from edgefilter.integrations.duplex import as_pcm16, from_pcm16

NOISE = 0.1 * np.random.default_rng(0).standard_normal(48_000).astype(np.float32)


@pytest.fixture(scope="module", autouse=True)
def livekit():
    """It takes three seconds to load: the process that runs these tests does it, not each that collects them."""
    global rtc, stt, room_io, EgoProcessor, Recogniser, Sink
    from livekit import rtc
    from livekit.agents import stt
    from livekit.agents.voice import room_io

    from edgefilter.integrations.livekit import EgoProcessor
    from tests.integrations.livekit_ends import Recogniser, Sink


@pytest.fixture
def ears():
    return EgoProcessor(EgoFilter(engine="linear"))


def frame_of(samples, rate=24_000, channels=1):
    return rtc.AudioFrame(as_pcm16(samples, channels), rate, channels, samples.size)


def through(ears, frame):
    """What a room makes of a frame: LiveKit calls this method of its FrameProcessor."""
    return ears._process(frame)


@pytest.mark.slow
async def test_a_robot_that_talks_is_interrupted_and_its_reference_is_what_it_played(example, ego, check_conversation):
    log, room, _ = await example("agent_livekit").converse(ego)
    check_conversation(room, ego, 3.0)
    kinds = [what.split(":")[0] for _, what in log]
    assert kinds == ["the human speaks", "the robot was interrupted", "the human said"]


async def test_an_audio_stream_sends_its_frames_through_it(ears):
    """A real one, of a local track; it runs on a clock of its own, so that only what comes out is looked at."""
    source = rtc.AudioSource(24_000, 1)
    track = rtc.LocalAudioTrack.create_audio_track("microphone", source)
    stream = rtc.AudioStream.from_track(
        track=track, sample_rate=24_000, num_channels=1, frame_size_ms=50, noise_cancellation=ears
    )
    feeding = asyncio.create_task(source.capture_frame(frame_of(NOISE[:12_000])))
    frames = [(await stream.__anext__()).frame for _ in range(8)]
    feeding.cancel()
    await stream.aclose()
    assert {frame.samples_per_channel for frame in frames} == {1200}
    assert 8 * 800 * 0.8 < ears.duplex.ego.stats()["samples"] <= 8 * 800 + 800


def test_the_room_s_options_take_it_for_noise_cancellation(ears):
    assert room_io.AudioInputOptions(noise_cancellation=ears).noise_cancellation is ears
    assert isinstance(ears, rtc.FrameProcessor) and ears.enabled


@pytest.mark.parametrize("rate, channels, ms", [(24_000, 1, 50), (48_000, 2, 10), (16_000, 1, 20), (44_100, 1, 10)])
def test_frames_come_out_as_long_as_they_went_in_and_late_by_less_than_a_fifth_of_a_second(ears, rate, channels, ms):
    count, out = rate * ms // 1000, []
    for at in range(0, NOISE.size - count, count):
        frame = through(ears, frame_of(NOISE[at : at + count], rate, channels))
        assert (frame.samples_per_channel, frame.sample_rate, frame.num_channels) == (count, rate, channels)
        out.append(from_pcm16(frame.data.cast("B"), channels))
    out = np.concatenate(out)
    started = np.flatnonzero(np.abs(out) > 0.02)[0] / rate
    assert 0.02 < started < 0.2
    assert np.mean(out[-rate // 2 :] ** 2) == pytest.approx(0.01, rel=0.7), "the microphone, as no robot speaks"


async def test_the_tap_hands_everything_on_and_notes_what_is_played_paused_and_dropped(ears):
    sink = Sink()
    tap = ears.tap(sink)
    await tap.capture_frame(frame_of(NOISE[:24_000]))
    tap.flush()
    assert ears.duplex.queued_s == pytest.approx(1.0, abs=1e-3)
    tap.pause()
    through(ears, frame_of(NOISE[:2400]))
    assert ears.duplex.stats()["played_s"] == 0
    tap.resume()
    tap.clear_buffer()
    assert tap.sample_rate == 24_000 and tap.can_pause
    assert sink.asked == [24_000, "flush", "pause", "resume", "clear"]
    assert ears.duplex.queued_s == 0 and ears.duplex.stats()["dropped_s"] == pytest.approx(1.0, abs=1e-3)


def test_the_tap_lowers_what_it_hands_on_where_the_filter_asks_for_it_and_so_is_the_reference(ears, monkeypatch):
    monkeypatch.setattr(EgoFilter, "voice_gain", 0.25)
    played, sink = [], Sink()
    monkeypatch.setattr(ears.duplex, "play_pcm16", lambda pcm, rate, channels: played.append(from_pcm16(pcm)))
    asyncio.run(ears.tap(sink).capture_frame(frame_of(NOISE[:2400])))
    np.testing.assert_allclose(sink.heard[0][240:], 0.25 * NOISE[240:2400], atol=1e-4)  # it fades for 10 ms
    np.testing.assert_array_equal(played, sink.heard)


async def test_after_a_pause_the_speech_that_the_room_had_thrown_away_is_no_reference(ears):
    """The room's output holds 0.2 s (livekit.agents.voice.room_io.ParticipantAudioOutput) and clears it when paused."""
    tap = ears.tap(Sink())
    await tap.capture_frame(frame_of(NOISE))
    tap.flush()
    tap.pause()
    tap.resume()
    assert ears.duplex.stats()["dropped_s"] == pytest.approx(0.2)
    assert ears.duplex.queued_s == pytest.approx(1.8, abs=1e-3)


def test_switched_off_it_gives_the_microphone_as_it_is(ears):
    ears.enabled = False
    assert not ears.enabled
    np.testing.assert_array_equal(through(ears, frame_of(NOISE[:1200])).data, frame_of(NOISE[:1200]).data)


@pytest.mark.parametrize("enabled", [True, False])
async def test_a_recogniser_behind_the_stream_adapter_gets_the_finished_turn_of_an_array(pair, enabled):
    profile, sound = pair
    events, recogniser = [], Recogniser()
    ears = EgoProcessor(EgoFilter(profile, engine="crnn"), events.append, mic_channels=[1, 2])
    ears.enabled = enabled
    streams = stream, watch = stt.StreamAdapter(stt=recogniser, vad=ears.vad()).stream(), ears.vad().stream()
    for at in range(0, len(sound) - 319, 320):
        pcm = np.rint(sound[at : at + 320] * 32768).astype("<i2").tobytes()
        frame = through(ears, rtc.AudioFrame(pcm, 16_000, 3, 320))
        for each in streams:
            each.push_frame(frame)
        await asyncio.sleep(0.001)
    for each in streams:
        each.end_input()
    assert [event.type.value async for event in stream] == ["start_of_speech", "end_of_speech", "final_transcript"]
    tell_how_long_the_human_has_spoken_or_been_silent([event async for event in watch])
    (turn,) = [event.turn for event in events if event.turn]
    (heard,) = recogniser.segments
    assert heard.num_channels == 1 and ears.duplex.ego.stats()["array"]["microphones"] == 2
    if enabled:
        np.testing.assert_array_equal(from_pcm16(heard.data.cast("B")), from_pcm16(as_pcm16(turn.samples)))
    else:
        assert heard.samples_per_channel > 24_000, "the microphone as it was, from half a second before"
    assert ears.duplex.listeners == []


def tell_how_long_the_human_has_spoken_or_been_silent(events):
    frames = [event for event in events if event.type.value == "inference_done"]
    (end,) = [event for event in events if event.type.value == "end_of_speech"]
    spoke = [event for event in frames if event.speaking]
    assert [event.speech_duration for event in spoke] == pytest.approx(0.02 * np.arange(1, len(spoke) + 1))
    assert end.speech_duration == pytest.approx(0.02 * len(spoke))
    silent = [event for event in frames if event.samples_index < spoke[0].samples_index]
    assert [event.silence_duration for event in silent] == pytest.approx(0.02 * np.arange(1, len(silent) + 1))
    assert {event.speech_duration for event in silent} == {0.0}


def test_the_loopback_of_the_device_is_the_reference_where_it_is_named(talking):
    profile, sound = talking
    ears = EgoProcessor(EgoFilter(profile, engine="linear"), mic_channels=[1, 2], reference_channel=0)
    pcm, out = np.rint(sound * 32768).astype("<i2"), []
    for at in range(0, len(pcm), 320):
        frame = through(ears, rtc.AudioFrame(pcm[at : at + 320].tobytes(), 16_000, 3, 320))
        out.append(from_pcm16(frame.data.cast("B"), 3))
    out, part = np.concatenate(out), slice(16_000, 32_000)
    assert np.mean(out[part] ** 2) < 0.01 * np.mean(sound[part, 1] ** 2), "no tap is there"
    assert ears.duplex.ego.stats()["array"]["microphones"] == 2


def test_a_voice_activity_that_would_not_notice_the_human_is_refused(ears):
    with pytest.raises(UsageError, match="vad.. got a filter whose engines .linear. do not all judge speech"):
        ears.vad()
