"""What stands at both ends of LiveKit's session in a test: its loudspeaker, and its recogniser."""

from livekit import rtc
from livekit.agents import stt
from livekit.agents.voice import io

from edgefilter.integrations.duplex import from_pcm16


class Sink(io.AudioOutput):
    """The end of an output's chain, which writes down what it was asked for."""

    def __init__(self):
        super().__init__(label="sink", capabilities=io.AudioOutputCapabilities(pause=True), sample_rate=24_000)
        self.asked, self.heard = [], []

    async def capture_frame(self, frame):
        await super().capture_frame(frame)
        self.heard.append(from_pcm16(frame.data.cast("B")))
        self.asked.append(frame.samples_per_channel)

    def flush(self):
        super().flush()
        self.asked.append("flush")

    def clear_buffer(self):
        self.asked.append("clear")

    def pause(self):
        self.asked.append("pause")

    def resume(self):
        self.asked.append("resume")


class Recogniser(stt.STT):
    """Keeps what it is to transcribe."""

    def __init__(self):
        super().__init__(capabilities=stt.STTCapabilities(streaming=False, interim_results=False))
        self.segments = []

    async def _recognize_impl(self, buffer, *, language, conn_options):
        self.segments.append(rtc.combine_audio_frames(buffer))
        words = [stt.SpeechData(language="en", text="words")]
        return stt.SpeechEvent(stt.SpeechEventType.FINAL_TRANSCRIPT, alternatives=words)
