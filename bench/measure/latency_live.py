"""What a user waits for: from process start to the first filtered hop, and from a click to the filtered click.

The click goes round: the filter listens to a virtual device's monitor and plays into that same device, so that the
click comes back again and again, and the distance between two of them in one recording is the whole way, to the sample.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import soundfile
from scipy import signal

import edgefilter
from bench.measure import virtual_sound
from bench.measure.latency_hops import peak_memory_mb
from edgefilter.types import SAMPLE_RATE

DEMO = Path(edgefilter.__file__).parent / "demo_data"
COMMAND = [sys.executable, "-m", "edgefilter.cli", "run"]
ALONE = "devices alone"
CLICK = 160
"""Samples of the click, a short chirp: 10 ms."""


def start(engine: str) -> dict[str, float]:
    """Seconds from process start to the first samples on a pipe, and the memory (MB) at that moment."""
    mic, ref = (
        soundfile.read(DEMO / f"{name}.flac", dtype="int16", frames=SAMPLE_RATE)[0] for name in ("mic", "reference")
    )
    command = [
        *COMMAND,
        "--input",
        "-",
        "--output",
        "-",
        "--engine",
        engine,
        "--profile",
        str(DEMO / "profile.npz"),
        "--quiet",
    ]
    began = time.perf_counter()
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdin.write(np.stack((mic, ref), axis=1)[:8192].tobytes())
    process.stdin.flush()
    process.stdout.read(2)
    took = time.perf_counter() - began
    memory = peak_memory_mb(process.pid)
    process.communicate()
    return {"seconds": took, "memory_mb": memory}


def click() -> np.ndarray:
    """(CLICK,) int16, a windowed chirp from 300 to 3000 Hz."""
    t = np.arange(CLICK) / SAMPLE_RATE
    return (16000 * signal.chirp(t, 300, t[-1], 3000) * np.hanning(CLICK)).astype(np.int16)


def round_trip(engine: str, clicks: int = 3) -> list[float]:
    """Milliseconds from click to click, one a click, through `edgefilter run` live.

    ALONE: through the same devices without a filter.
    """
    with virtual_sound.server() as server, tempfile.TemporaryDirectory() as folder:
        wav, heard = Path(folder) / "click.wav", Path(folder) / "heard.raw"
        soundfile.write(wav, np.concatenate((np.zeros(8000, np.int16), click(), np.zeros(1600, np.int16))), SAMPLE_RATE)
        devices = ["robot_mic_monitor", "robot_monitor", "robot_mic"]
        if engine == ALONE:
            command = [sys.executable, "-m", "bench.measure.latency_live", *devices]
        else:
            command = [
                *COMMAND,
                "--input",
                devices[0],
                "--reference",
                devices[1],
                "--output",
                devices[2],
                "--engine",
                engine,
                "--quiet",
            ]
        found = []
        for _ in range(clicks):
            with open(heard, "wb") as file:
                recorder = subprocess.Popen(
                    ["parec", "-d", "robot_mic.monitor", "--rate=16000", "--format=s16le", "--channels=1"]
                    + ["--latency-msec=20"],
                    env=server.environment, stdout=file,
                )  # fmt: skip
                loop = subprocess.Popen(command, env=server.environment, stderr=subprocess.DEVNULL)
                _wait_for_sound(server)
                subprocess.run(["paplay", "-d", "robot_mic", str(wav)], env=server.environment, check=True)
                time.sleep(1.0)
                loop.terminate()
                loop.wait()
                recorder.terminate()
                recorder.wait()
            found.append(distance_ms(np.fromfile(heard, "<i2").astype(np.float64)))
        return found


def _wait_for_sound(server: virtual_sound.Server) -> None:
    """Return half a second after somebody has begun to play."""
    for _ in range(300):
        playing = subprocess.run(
            ["pactl", "list", "short", "sink-inputs"], env=server.environment, capture_output=True, text=True
        )
        if playing.stdout.strip():
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
