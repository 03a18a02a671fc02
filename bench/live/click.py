"""What a user waits for: from process start to the first filtered samples, and from a click to the filtered click.

The click goes round: the filter listens to a virtual device's monitor and plays into that same device, so that the
click comes back again and again, and the distance between two of them in one recording is the whole way, to the sample.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import soundfile
from scipy import signal

from bench import provenance, results
from bench.live import virtual_sound
from edgefilter.filter.budget import DEMO
from edgefilter.types import SAMPLE_RATE

COMMAND = [sys.executable, "-m", "edgefilter.cli", "run"]
ALONE = "devices alone"
ENGINES = ("linear", "ss", "crnn")
CLICK = 160
"""Samples of the click, a short chirp: 10 ms."""


def run(options: argparse.Namespace) -> str:
    names = [options.engine] if options.engine else list(ENGINES)
    made_with = provenance.stamp({"DEMO": [DEMO]}, names)
    starts = {name: [start(name) for _ in range(options.count)] for name in names}
    clicks = {name: round_trip(name, options.count) for name in (ALONE, *names)}
    devices = float(np.nanmedian(clicks[ALONE]))
    rows = []
    for name, times in clicks.items():
        seconds, memory = np.median(starts[name], axis=0).tolist() if name in starts else (None, None)
        middle, least, most = (float(of(times)) for of in (np.nanmedian, np.nanmin, np.nanmax))
        rows.append([name, seconds, memory, middle, least, most, middle - devices])
    columns = ["", ("start to first samples, s", 2), ("memory then, MB", 0), ("click to click, ms", 0), ("least", 0),
               ("most", 0), ("beyond the devices", 0)]  # fmt: skip
    text = "Through virtual devices (PulseAudio, PortAudio over ALSA); medians. A hop has to be complete before it is filtered."
    table = results.table("click", "What a user waits for", columns, rows, text)
    title = "From a click to the filtered click"
    return results.write(options.output, "click", title, made_with, [table], clicks=clicks)


def start(engine: str) -> tuple[float, float]:
    """Seconds from process start to the first samples on a pipe, and the memory (MB) at that moment."""
    mic, ref = (soundfile.read(DEMO / f"{name}.flac", dtype="int16", frames=8192)[0] for name in ("mic", "reference"))
    command = [*COMMAND, "--input", "-", "--output", "-", "--engine", engine, "--quiet"]
    command += ["--profile", str(DEMO / "profile.npz")]
    pipe, began = subprocess.PIPE, time.perf_counter()
    process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe)
    process.stdin.write(np.stack((mic, ref), axis=1).tobytes())
    process.stdin.flush()
    process.stdout.read(2)
    took = time.perf_counter() - began
    memory = virtual_sound.memory_mb(process.pid)
    process.communicate()
    return took, memory


def click() -> np.ndarray:
    """A windowed chirp from 300 to 3000 Hz, (CLICK,) int16."""
    t = np.arange(CLICK) / SAMPLE_RATE
    return (16000 * signal.chirp(t, 300, t[-1], 3000) * np.hanning(CLICK)).astype(np.int16)


def round_trip(engine: str, clicks: int = 3) -> list[float]:
    """Milliseconds from click to click through `edgefilter run` live; ALONE: through the devices without a filter."""
    devices = ["robot_mic_monitor", "robot_monitor", "robot_mic"]
    command = [*COMMAND, "--input", devices[0], "--reference", devices[1], "--output", devices[2], "--engine", engine]
    command = [sys.executable, "-m", "bench.live.click", *devices] if engine == ALONE else [*command, "--quiet"]
    listen = ["parec", "-d", "robot_mic.monitor", "--rate=16000", "--format=s16le", "--channels=1", "--latency-msec=20"]
    with virtual_sound.server() as server, tempfile.TemporaryDirectory() as folder:
        wav, recorded = Path(folder) / "click.wav", Path(folder) / "recorded.raw"
        soundfile.write(wav, np.concatenate((np.zeros(8000, np.int16), click(), np.zeros(1600, np.int16))), SAMPLE_RATE)
        found = []
        for _ in range(clicks):
            with open(recorded, "wb") as file:
                recorder = subprocess.Popen(listen, env=server.environment, stdout=file)
                loop = subprocess.Popen(command, env=server.environment, stderr=subprocess.DEVNULL)
                _wait_for_sound(server)
                subprocess.run(["paplay", "-d", "robot_mic", str(wav)], env=server.environment, check=True)
                time.sleep(1.0)
                for process in (loop, recorder):
                    process.terminate()
                    process.wait()
            found.append(distance_ms(np.fromfile(recorded, "<i2").astype(np.float64)))
        return found


def _wait_for_sound(server: virtual_sound.Server) -> None:
    """Return half a second after somebody has begun to play."""
    asked = ["pactl", "list", "short", "sink-inputs"]
    for _ in range(300):
        if subprocess.run(asked, env=server.environment, capture_output=True, text=True).stdout.strip():
            break
        time.sleep(0.1)
    time.sleep(0.5)


def distance_ms(recording: np.ndarray) -> float:
    """Milliseconds between the first click in recording (n,) and the next; NaN where there are not two."""
    match = np.correlate(recording, click().astype(np.float64), "valid")
    peaks, _ = signal.find_peaks(match, height=0.2 * match.max(), distance=2 * CLICK)
    return 1000 * float(peaks[1] - peaks[0]) / SAMPLE_RATE if peaks.size > 1 else float("nan")


def pass_through(mic: str, reference: str, output: str) -> None:
    """What the devices themselves need: blocks from the source straight into the sink."""
    from edgefilter.audio.live import LiveSink, LiveSource

    with LiveSource(mic, reference) as source, LiveSink(output, wait=False) as sink:
        for block in source:
            sink.write(block.mic)


if __name__ == "__main__":
    pass_through(*sys.argv[1:])
