"""Against the real Pipecat: its transports, its pipeline, its frames."""

import asyncio

import numpy as np
import pytest
from pipecat.frames.frames import FilterEnableFrame
from pipecat.transports.base_transport import TransportParams

from edgefilter import EgoFilter
from edgefilter.integrations.duplex import as_pcm16, from_pcm16
from edgefilter.integrations.pipecat import EgoFilters

NOISE = 0.1 * np.random.default_rng(0).standard_normal(3200).astype(np.float32)


@pytest.fixture
def filters():
    return EgoFilters(EgoFilter(engine="linear"), in_channels=2)


def test_a_robot_that_talks_is_interrupted_and_its_reference_is_what_it_played(example, ego, check_conversation):
    log, room, _ = asyncio.run(asyncio.wait_for(example("agent_pipecat").converse(ego), 120))
    check_conversation(room, ego, 3.0)
    kinds = [what.split(":")[0] for _, what in log]
    assert kinds == ["the robot speaks", "the human speaks", "the robot is silent", "the human said"]


def test_both_faces_are_filters_of_a_transport(filters):
    params = TransportParams(audio_in_enabled=True, audio_out_enabled=True, **filters.params)
    assert params.audio_in_filter is not params.audio_out_filter


def test_the_loudspeaker_s_sound_is_left_alone_and_noted_at_its_rate(filters):
    async def speak():
        await filters.params["audio_out_filter"].start(24_000)
        return await filters.params["audio_out_filter"].filter(as_pcm16(NOISE))

    assert asyncio.run(speak()) == as_pcm16(NOISE)
    filters.duplex.end()
    assert filters.duplex.queued_s == pytest.approx(3200 / 24_000, abs=1e-3)


def test_a_stereo_microphone_stays_stereo(filters):
    async def hear():
        await filters.params["audio_in_filter"].start(16_000)
        return await filters.params["audio_in_filter"].filter(as_pcm16(NOISE, 2))

    out = np.frombuffer(asyncio.run(hear()), "<i2").reshape(-1, 2)
    assert 2500 < len(out) < 3200 and out.any() and (out[:, 0] == out[:, 1]).all()


def test_it_can_be_switched_off_while_it_runs(filters):
    async def hear():
        await filters.params["audio_out_filter"].process_frame(FilterEnableFrame(enable=False))
        return await filters.params["audio_in_filter"].filter(as_pcm16(NOISE, 2))

    np.testing.assert_array_equal(from_pcm16(asyncio.run(hear()), 2), from_pcm16(as_pcm16(NOISE)))


def test_the_voice_activity_is_the_filter_s_own_judgement(filters, monkeypatch):
    vad = filters.vad()
    vad.set_sample_rate(24_000)
    assert vad.num_frames_required() == 384, "one hop of the filter"
    assert vad.voice_confidence(b"") == 0.0
    monkeypatch.setattr(EgoFilter, "human_speaks", True)
    assert vad.voice_confidence(b"") == 1.0
