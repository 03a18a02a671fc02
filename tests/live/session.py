"""What the live tests run in a process of its own, since PortAudio reads the list of devices once.

Usage: session.py JOB FOLDER.
"""

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import soundfile

from edgefilter.audio.device import list_devices, monitor_of
from edgefilter.audio.live import LiveSink, LiveSource
from edgefilter.audio.measure import play_and_record
from edgefilter.commands.run import limited
from edgefilter.errors import EdgefilterError

folder = Path(sys.argv[2])


def collect(source, after_first=lambda: None):
    blocks = []
    for block in source:
        if not blocks:
            after_first()
        blocks.append(block)
    return np.concatenate([b.mic for b in blocks]), np.concatenate([b.ref for b in blocks]), blocks


def receive():
    players = []

    def play():
        players.extend(
            subprocess.Popen(["paplay", "-d", sink, str(folder / f"{sink}.wav")]) for sink in ("robot", "robot_mic")
        )

    with LiveSource("robot_mic_monitor", monitor_of("robot")) as source:
        mic, ref, blocks = collect(limited(source, 4 * 16000), play)
    for player in players:
        player.wait()
    np.savez(folder / "received.npz", mic=mic, ref=ref)
    gapless = all(a.start + a.mic.size == b.start for a, b in zip(blocks, blocks[1:]))
    return {"stats": source.stats(), "notes": source.notes, "gapless": gapless}


def vanish():
    with LiveSource("robot_mic_monitor", "robot_monitor") as source:
        samples = 0
        try:
            for block in source:
                samples += block.mic.size
                if samples > 8000:
                    os.kill(int(sys.argv[3]), signal.SIGKILL)
        except EdgefilterError as error:
            return {"error": type(error).__name__, "text": str(error), "samples": samples}
    return {"error": None}


def sink():
    sound, _ = soundfile.read(folder / "robot.wav", dtype="float32")
    heard = []
    source = LiveSource("robot_mic_monitor")
    with source:
        reader = threading.Thread(target=lambda: heard.extend(collect(limited(source, 4 * 16000))[:1]))
        reader.start()
        with LiveSink("robot_mic", latency=512) as output:
            for start in range(0, sound.size, 256):
                output.write(sound[start : start + 256])
        reader.join()
    np.savez(folder / "received.npz", mic=heard[0])
    return {"sink": output.stats(), "source": source.stats()}


def measure():
    sound, _ = soundfile.read(folder / "robot.wav", dtype="float32")
    np.savez(folder / "received.npz", mic=play_and_record("robot", "robot_monitor", sound)[0])
    return {"size": sound.size}


def stop():
    source = LiveSource("robot_mic_monitor", "robot_monitor")
    signal.signal(signal.SIGINT, lambda *_: source.stop())
    with source:
        mic, ref, _ = collect(source, lambda: os.kill(os.getpid(), signal.SIGINT))
    return {"mic": mic.size, "ref": ref.size}


def devices():
    return {"devices": list_devices(), "monitor": str(monitor_of("robot_mic"))}


print("RESULT " + json.dumps(globals()[sys.argv[1]]()))
