"""Against the real Pipecat: its transports, its pipeline, its frames."""

import asyncio

import numpy as np
import pytest
from pipecat.frames.frames import FilterEnableFrame, InputAudioRawFrame, TranscriptionFrame
from pipecat.pipeline.pipeline import Pipeline
from pipecat.pipeline.worker import PipelineWorker
from pipecat.processors.audio.vad_processor import VADProcessor
from pipecat.processors.frame_processor import FrameProcessor
from pipecat.services.settings import STTSettings
from pipecat.services.stt_service import SegmentedSTTService
from pipecat.transports.base_input import BaseInputTransport
from pipecat.transports.base_transport import TransportParams
from pipecat.workers.runner import WorkerRunner

from edgefilter import BargeInSettings, EgoFilter, UsageError
from edgefilter.integrations.duplex import as_pcm16, from_pcm16
from edgefilter.integrations.pipecat import EgoFilters

NOISE = 0.1 * np.random.default_rng(0).standard_normal(3200).astype(np.float32)


@pytest.fixture
def filters():
    return EgoFilters(EgoFilter(engine="linear"), in_channels=2)


@pytest.mark.slow
async def test_a_robot_that_talks_is_interrupted_and_its_reference_is_what_it_played(example, ego, check_conversation):
    log, room, _ = await example("agent_pipecat").converse(ego)
    check_conversation(room, ego, 3.0)
    kinds = [what.split(":")[0] for _, what in log]
    again = ["the robot speaks", "the robot is silent"]  # Pipecat may deliver one frame taken before the interruption
    once = ["the robot speaks", "the human speaks", "the robot is silent"]
    assert kinds in ([*once, "the human said"], [*once, *again, "the human said"])


def test_both_faces_are_filters_of_a_transport(filters):
    params = TransportParams(audio_in_enabled=True, audio_out_enabled=True, **filters.params)
    assert params.audio_in_filter is not params.audio_out_filter


@pytest.mark.parametrize("end", ["in", "out"])
def test_a_stereo_transport_that_the_filters_were_not_told_of_is_refused(end):
    """Its samples would be taken for mono at half the pace, and the robot would stay in the microphone."""
    with pytest.raises(TypeError, match=f"audio_{end}_channels"):
        TransportParams(**{f"audio_{end}_channels": 2}, **EgoFilters(EgoFilter(engine="linear")).params)
    told = TransportParams(**EgoFilters(EgoFilter(engine="linear"), in_channels=2, out_channels=2).params)
    assert (told.audio_in_channels, told.audio_out_channels) == (2, 2)


async def test_the_loudspeaker_s_sound_is_left_alone_and_noted_at_its_rate(filters):
    await filters.params["audio_out_filter"].start(24_000)
    assert await filters.params["audio_out_filter"].filter(as_pcm16(NOISE)) == as_pcm16(NOISE)
    filters.duplex.end()
    assert filters.duplex.queued_s == pytest.approx(3200 / 24_000, abs=1e-3)


async def test_the_loudspeaker_s_sound_is_lowered_where_the_filter_asks_for_it_and_so_is_the_reference(
    filters, monkeypatch
):
    monkeypatch.setattr(EgoFilter, "voice_gain", 0.25)
    await filters.params["audio_out_filter"].start(16_000)
    sent = from_pcm16(await filters.params["audio_out_filter"].filter(as_pcm16(NOISE)))
    faded = round(0.01 * 16_000)
    np.testing.assert_allclose(sent[faded:], 0.25 * NOISE[faded:], atol=1e-4)
    filters.duplex.end()
    filters.duplex.hear(np.zeros(sent.size, np.float32), 16_000)
    assert filters.duplex.stats()["played_s"] == pytest.approx(sent.size / 16_000)


async def test_a_stereo_loudspeaker_that_nobody_told_of_is_noticed(caplog):
    """Taken for one channel the reference would last twice as long as the speech: -2 dB instead of -27, without a word."""
    ears = EgoFilters(EgoFilter(engine="linear"))
    for part in np.split(NOISE, 10):
        await ears.params["audio_out_filter"].filter(as_pcm16(part, 2))
    ears.duplex.end()
    assert ears.duplex.queued_s == pytest.approx(3200 / 16_000, abs=1e-3)
    assert [record.levelname for record in caplog.records] == ["WARNING"] and "out_channels=2" in caplog.text


async def test_a_stereo_microphone_stays_stereo(filters):
    await filters.params["audio_in_filter"].start(16_000)
    out = np.frombuffer(await filters.params["audio_in_filter"].filter(as_pcm16(NOISE, 2)), "<i2").reshape(-1, 2)
    assert 2500 < len(out) < 3200 and out.any() and (out[:, 0] == out[:, 1]).all()


async def test_the_loopback_of_the_device_is_the_reference_where_it_is_named(talking):
    profile, sound = talking
    ears = EgoFilters(EgoFilter(profile, engine="linear"), in_channels=3, mic_channels=[1, 2], reference_channel=0)
    pcm = np.rint(sound * 32768).astype("<i2")
    heard = []

    class Listener(FrameProcessor):
        async def process_frame(self, frame, direction):
            await super().process_frame(frame, direction)
            if isinstance(frame, InputAudioRawFrame):
                heard.append(from_pcm16(frame.audio, frame.num_channels))
            await self.push_frame(frame, direction)

    await pipeline(ears, sound, Listener())
    both, out = pcm.astype(np.float32) / 32768, np.concatenate(heard)
    expected = EgoFilter(profile, engine="linear").process(both[:, 1:], both[:, 0])
    np.testing.assert_allclose(out, expected[: out.size], atol=1 / 32768)
    part = slice(16_000, 32_000)
    assert np.mean(out[part] ** 2) < 0.01 * np.mean(both[part, 1] ** 2), "nothing was handed to the loudspeaker"
    with pytest.raises(UsageError, match="3 channels, 0 to 2, found channel 3"):
        EgoFilters(EgoFilter(engine="linear"), in_channels=3, mic_channels=[1, 2], reference_channel=3)


async def test_it_can_be_switched_off_while_it_runs(filters):
    await filters.params["audio_out_filter"].process_frame(FilterEnableFrame(enable=False))
    out = await filters.params["audio_in_filter"].filter(as_pcm16(NOISE, 2))
    np.testing.assert_array_equal(from_pcm16(out, 2), from_pcm16(as_pcm16(NOISE)))


async def confidences(room_of, filters, switched_off_s):
    """The VAD's confidence every 20 ms: robot from 0 to 2.5 s, human from 1 s to 3.5 s, then nobody but the fan."""
    vad, (microphone, loudspeaker) = filters.vad(), (filters.params[f"audio_{end}_filter"] for end in ("in", "out"))
    room, found = room_of.Room(), []
    await loudspeaker.filter(as_pcm16(room_of.ROBOT[:40_000]))
    filters.duplex.end()
    room.play(room_of.ROBOT[:40_000])
    for step in range(250):
        if step == 50:
            room.speak()
        if step == 175:
            room.human_from = None
        if step == round(50 * switched_off_s):
            await microphone.process_frame(FilterEnableFrame(enable=False))
        await microphone.filter(as_pcm16(room.hear(320)))
        found.append(vad.voice_confidence(b""))
    return np.array(found)


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("switched_off_s", [6.0, 2.0, 0.2], ids=["never", "while the human speaks", "before"])
def test_the_voice_activity_is_the_human_s_also_while_the_filter_is_switched_off(room_of, switched_off_s):
    filters = EgoFilters(EgoFilter(room_of.PROFILE, engine="crnn"))
    found = asyncio.run(confidences(room_of, filters, switched_off_s))
    assert not found[:50].any() and found[90:160].all(), "0.2 s to notice were seen"
    assert not found[220:].any(), "0.5 s of pause end it"


def test_the_voice_activity_is_asked_for_once_a_hop(room_of):
    vad = EgoFilters(EgoFilter(engine="crnn")).vad()
    vad.set_sample_rate(24_000)
    assert vad.num_frames_required() == 384


@pytest.mark.parametrize("settings", [{"engine": "ss"}, {"budget_ms": 8}], ids=["ss", "may step down to ss"])
def test_a_voice_activity_that_would_not_notice_the_human_is_refused(settings):
    with pytest.raises(UsageError, match="ss.* do not all judge speech.*judge='network'"):
        EgoFilters(EgoFilter(**settings)).vad()


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("settings", [{"engine": "ss"}, {"budget_ms": 1e-6}], ids=["ss", "no hop within the budget"])
def test_with_the_network_as_judge_the_human_is_noticed_whatever_the_engine_and_the_budget(room_of, settings):
    ego = EgoFilter(room_of.PROFILE, **settings, barge_in=BargeInSettings(judge="network"))
    found = asyncio.run(confidences(room_of, EgoFilters(ego), 6.0))
    assert found[90:160].all() and not found[220:].any()


class Microphones(BaseInputTransport):
    """Three channels, as fast as the pipeline follows."""

    def __init__(self, sound, params, over):
        super().__init__(params)
        self.sound, self.over = sound, over

    async def start(self, frame):
        await super().start(frame)
        await self.set_transport_ready(frame)
        self.create_task(self.listen())

    async def listen(self):
        for at in range(0, len(self.sound), 320):
            pcm = np.rint(self.sound[at : at + 320] * 32768).astype("<i2").tobytes()
            await self.push_audio_frame(InputAudioRawFrame(pcm, 16_000, 3))
            await self._audio_in_queue.join()
            await asyncio.sleep(0.002)
        self.over.set()


async def pipeline(filters, sound, *processors):
    """Let a transport of these filters hear the sound before the processors, the last of which may recognise it."""
    over = asyncio.Event()
    params = TransportParams(audio_in_enabled=True, audio_in_sample_rate=16_000, **filters.params)
    worker = PipelineWorker(Pipeline([Microphones(sound, params, over), *processors]))
    runner = WorkerRunner(handle_sigint=False)
    await runner.add_workers(worker)
    running = asyncio.create_task(runner.run())
    await over.wait()
    for _ in range(200):
        if getattr(processors[-1], "segments", True):
            break
        await asyncio.sleep(0.02)
    await worker.cancel()
    await running


class Recogniser(SegmentedSTTService):
    """Keeps what it is to transcribe."""

    wants_wav_segments = False

    def __init__(self):
        super().__init__(sample_rate=16_000, trailing_silence_secs=0, settings=STTSettings(model=None, language=None))
        self.segments = []

    async def run_stt(self, audio):
        self.segments.append(audio)
        yield TranscriptionFrame("words", "", "")


async def test_a_segmented_recogniser_gets_the_finished_turn_of_an_array(pair):
    profile, sound = pair
    events = []
    filters = EgoFilters(EgoFilter(profile, engine="crnn"), in_channels=3, mic_channels=[1, 2], on_event=events.append)
    recogniser = Recogniser()
    await pipeline(filters, sound, VADProcessor(vad_analyzer=filters.vad()), filters.turns(), recogniser)
    (turn,) = [event.turn for event in events if event.turn]
    assert recogniser.segments == [as_pcm16(turn.samples)]
    assert filters.duplex.ego.stats()["array"]["microphones"] == 2
    assert filters.duplex.listeners == [], "the pipeline has ended"
