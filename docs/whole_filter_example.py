"""The whole filter with onnxruntime alone: nothing of edgefilter is imported, so the same few calls work in C++, Rust or JavaScript.

    python -m export.whole_filter --model models/crnn.onnx --output whole_filter.onnx
    python docs/whole_filter_example.py whole_filter.onnx mic.wav reference.wav human.wav

Both recordings are 16-bit mono WAV at the filter's rate. Alignment is left to the caller: reference.wav has to be sample by sample what
the loudspeaker played while mic.wav was recorded. The linear stage starts knowing nothing; a calibrated impulse response would go in
where the zeros are.
"""

import json
import sys
import wave

import numpy as np
import onnxruntime


def read(path, rate):
    with wave.open(path) as file:
        assert (file.getframerate(), file.getnchannels(), file.getsampwidth()) == (rate, 1, 2), f"{path} is not {rate} Hz mono 16 bit"
        return np.frombuffer(file.readframes(file.getnframes()), np.int16).astype(np.float32) / 32768


model, mic_path, reference_path, output_path = sys.argv[1:]
options = onnxruntime.SessionOptions()
options.intra_op_num_threads = 1
step = onnxruntime.InferenceSession(model, options)
start = onnxruntime.InferenceSession(model.replace(".onnx", "_start.onnx"), options)
about = step.get_modelmeta().custom_metadata_map
rate, hop, latency, taps = (int(about[key]) for key in ("sample_rate", "hop", "latency", "taps"))
names = [name for name, shape in json.loads(about["states"])]

mic, reference = read(mic_path, rate), read(reference_path, rate)
count = min(mic.size, reference.size)
hops = -(-(count + latency) // hop)
mic, reference = (np.pad(x[:count], (0, hops * hop - count)) for x in (mic, reference))

state = start.run(None, {"impulse_response": np.zeros(taps, np.float32)})
finished, most = [], 0.0
for at in range(0, hops * hop, hop):
    inputs = {"mic": mic[at : at + hop], "reference": reference[at : at + hop], **dict(zip(names, state))}
    human, speech_probability, *state = step.run(None, inputs)
    finished.append(human)
    most = max(most, float(speech_probability[0]))

early = latency - hop  # samples that come out before those of the recording
human = np.concatenate(finished)[early : early + count]
with wave.open(output_path, "wb") as file:
    file.setparams((1, 2, rate, count, "NONE", ""))
    file.writeframes(np.clip(np.round(human * 32768), -32768, 32767).astype(np.int16).tobytes())
print(f"{count / rate:.1f} s filtered, a human was there with a probability of up to {most:.2f}")
