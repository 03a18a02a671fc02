"""What somebody said, by Whisper where there is one: what the examples of agents use as their recogniser.

    python words.py said.wav [WHISPER]

WHISPER is a model for faster-whisper, a folder or a name such as base; without one, all that is said is how long it
was.
"""

import sys

import soundfile


class Words:
    def __init__(self, model=None):
        if model:
            from faster_whisper import WhisperModel

            self.model = WhisperModel(model, device="cpu", cpu_threads=1, compute_type="int8")
        else:
            self.model = None

    def __call__(self, samples):
        """The words in samples (n,) at 16 kHz."""
        if self.model is None:
            return f"({samples.size / 16_000:.1f} s)"
        segments, _ = self.model.transcribe(samples, language="en", beam_size=5)
        return " ".join(segment.text.strip() for segment in segments)


if __name__ == "__main__":
    said, _ = soundfile.read(sys.argv[1], dtype="float32")
    print(Words(*sys.argv[2:])(said))
