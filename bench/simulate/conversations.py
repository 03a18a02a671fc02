r"""Simulate whole conversations with a robot, to evaluate and tune the filter on.

The robot speaks, pauses, speaks again, a human interrupts.

    python -m bench.simulate.conversations --speech human/val --voices robot/val robot/train --kind live \
        --count 24 --seed 1 --output DIR

--speech and --voices are folders with a transcripts.tsv (path, speaker, seconds, text). Each conversation is a folder:
sweep_ref, sweep_mic, fan_only (always recorded in a laboratory), ref, mic, clean (the human at the microphone, already
inside mic), all FLAC, 16 kHz, 16 bit, and meta.json: room, rt60, voice, speaker, text, positions in samples (start and
end of the human in mic, t_main: onset of the second utterance in ref, lag), snr_fan and sisdr_mix over [start, end],
nl_db (distortion relative to the linear loudspeaker, best gain removed), delay (of the direct sound in sweep_mic),
seed, said (the robot's sentences, each with its first and last sample in ref). True delay of the reference in mic:
lag + delay - ppm 1e-6 t. Kinds: `paper`, one lag of 50-300 ms; `live`, lag before t_main and lag2 after (0-1.2 s each),
volume turned by up to 3 dB between them (volume_db), clocks 10-300 ppm apart (either sign). Even conversations take
place in the laboratory (RT60 0.20-0.26 s), odd ones in an office (0.50-0.75 s). Item i of a seed is the same whatever
--count is, and with --microphone but for what that changes.

How it compares with a set of ten `paper` conversations simulated by other hands (lab / office means: theirs; then 60 of
these with --distortion strong):
- unfiltered SI-SDR -21.6 / -26.3; -22.2 / -26.1 dB
- over the fan: human (snr_fan) 6.0 / 6.7; 7.4 / 7.3 dB, robot that speaks alone 29 / 34; 30 / 34 dB
- robot removed by the best linear filter of 300 ms, fitted to the first utterance, 19.7 / 15.8; 20.3 / 17.6 dB,
  at the onset of the second 17.6 / 14.3; 18.6 / 15.4 dB; its direct sound over reverberation 15.7 / 8.3; 15.9 / 10.9 dB
Their nl_db is -22 / -24 dB, that of the strong set -19 / -15 dB, that of the moderate set as theirs.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import soundfile as sf
from scipy import signal
from tqdm import tqdm

from bench.simulate import simulated_robot as physics
from bench.simulate.microphones import MICROPHONES
from bench.simulate.simulated_robot import RATE, Array, Rng, Robot
from edgefilter.dsp.metrics import si_sdr

UNFILTERED_DB = {"lab": (-22.0, 1.0), "office": (-26.2, 0.9)}
"""Mean and standard deviation of the unfiltered SI-SDR: the human's level varies little between two conversations."""
DISTORTION_DB = {
    "moderate": {"lab": (-26.0, -21.0), "office": (-27.0, -21.0)},
    "strong": {"lab": (-21.0, -17.0), "office": (-17.5, -13.5)},
}
"""Range of the loudspeaker's distortion at the microphone. moderate: the nl_db that the set described above states.
strong: so much that the best linear filter of 300 ms leaves about as much of the robot as in that set, although in an
office a part of what it leaves there is reverberation behind the 300 ms."""


@dataclass(frozen=True)
class Clip:
    """A recording of a folder of speech, who speaks in it, and what."""

    path: Path
    speaker: str
    text: str


Voices = dict[str, list[Clip]]
"""The robot's sentences by voice."""
Sentence = tuple[str, int, int]
"""What the robot says, and its first and last sample."""


@dataclass(frozen=True)
class Scene:
    """A conversation that can be recorded again, should the robot say less of what it was to say.

    signals: by name, as written. response, gain: from the loudspeaker to the microphone's samples. fan: (n,) in mic.
    """

    signals: dict[str, Array]
    meta: dict
    robot: Robot
    response: Array
    gain: float
    fan: Array

    def echo(self, ref: Array) -> Array:
        """The robot at the microphone for the reference (n,), (n,)."""
        return self.gain * self.robot.record(played(ref, self.meta), self.response)

    def mic(self, ref: Array) -> Array:
        """What the microphone records for the reference (n,), (n,): human and fan are the same whatever the robot says."""
        return self.echo(ref) + self.signals["clean"] + self.fan


def read_clips(folder: Path, seconds: tuple[float, float]) -> list[Clip]:
    """The clips of a folder that have a text and a length between these bounds."""
    table = folder / "transcripts.tsv"
    if not table.is_file():
        wanted = "expected a folder of speech with its transcripts.tsv (path, speaker, seconds, text)"
        sys.exit(f"{table} is missing; {wanted}")
    with table.open(encoding="utf-8", newline="") as lines:
        rows = [row for row in csv.reader(lines, delimiter="\t", quoting=csv.QUOTE_NONE) if len(row) == 4 and row[3]]
    clips = [Clip(folder / row[0], row[1], row[3]) for row in rows if seconds[0] <= float(row[2]) <= seconds[1]]
    if not clips:
        sys.exit(f"{table} lists no clip of {seconds[0]}-{seconds[1]} s with a text; expected at least one")
    return clips


def read_voices(folders: list[Path]) -> Voices:
    voices: Voices = {}
    for clip in (clip for folder in folders for clip in read_clips(folder, (1.0, 15.0))):
        voices.setdefault(clip.speaker, []).append(clip)
    return voices


def read_speech(clip: Clip) -> Array:
    samples, rate = sf.read(clip.path)
    if rate != RATE or samples.ndim != 1:
        sys.exit(f"{clip.path} has {rate} Hz and shape {samples.shape}; expected {RATE} Hz mono")
    loud = np.flatnonzero(np.abs(samples) > 0.01 * np.abs(samples).max())
    return samples[loud[0] : loud[-1] + 1]


def read_utterance(rng: Rng, clips: list[Clip], at_least: float) -> tuple[Array, list[Sentence]]:
    """Sentences of one voice in random order until they last at_least seconds, 0.1-0.4 s apart, and where they are."""
    parts: list[Array] = []
    said: list[Sentence] = []
    for i in rng.permutation(len(clips)):
        at = sum(part.size for part in parts)
        parts += [read_speech(clips[i]), np.zeros(int(rng.uniform(0.1, 0.4) * RATE))]
        said.append((clips[i].text, at, at + parts[-2].size))
        if at + parts[-2].size >= at_least * RATE:
            break
    return np.concatenate(parts[:-1]), said


def draw_lags(rng: Rng, kind: str, pause: int) -> tuple[int, int, float, float]:
    """Lag of either utterance in samples (the second begins when the first is over), ppm, volume change in dB."""
    if kind == "paper":
        lag = int(rng.uniform(0.05, 0.3) * RATE)
        return lag, lag, 0.0, 0.0
    ppm = rng.choice([-1.0, 1.0]) * math.exp(rng.uniform(math.log(10), math.log(300)))
    while True:
        first, second = (int(lag * RATE) for lag in rng.uniform(0.0, 1.2, size=2))
        if second > first - pause + RATE // 10 and abs(second - first) > 320:
            return first, second, ppm, rng.uniform(-3, 3)


def make_scene(
    seed: int,
    index: int,
    kind: str,
    speech: list[Clip],
    voices: Voices,
    distortion: str = "moderate",
    microphone: str | None = None,
) -> Scene:
    """Item number index of this seed: signals (n,) float64 and the contents of meta.json. Whatever the microphone, all else of it is the same."""
    rng = np.random.default_rng([seed, index])
    human_clip = speech[np.random.default_rng(seed).permutation(len(speech))[index % len(speech)]]
    voice = str(rng.choice(sorted(voices)))
    room_name = "lab" if index % 2 == 0 else "office"
    robot, human_m = physics.draw_robot(rng), rng.uniform(1.0, 1.5)
    about = robot.distance_m, robot.direction, human_m
    laboratory = physics.draw_room(rng, "lab", *about)
    room = physics.draw_room(rng, "office", *about) if room_name == "office" else laboratory
    human = read_speech(human_clip)
    script, ref = make_script(rng, kind, voices[voice], human.size)
    voice_heard = played(ref, script)
    wanted_db = rng.uniform(*DISTORTION_DB[distortion][room_name])
    robot, nl_db = physics.with_distortion(robot, voice_heard, room.robot, wanted_db)
    start = script.pop("onset") + robot.bulk
    voiced = signal.oaconvolve(human, room.human)[: ref.size - start]
    clean = np.concatenate([np.zeros(start), voiced, np.zeros(ref.size - start - voiced.size)])
    end = min(start + human.size + RATE // 10, ref.size)
    paths, span = (laboratory.robot, room.robot), slice(start, end)
    signals, scores, gain = record_all(rng, room_name, robot, paths, voice_heard, clean, span, noises)
    if microphone:
        signals = MICROPHONES[microphone](np.random.default_rng([seed, index, 1]), signals, voice_heard)
        scores["sisdr_mix"] = si_sdr(signals["mic"][span], signals["clean"][span])
    impulse = np.eye(1, 4096)[0]
    delay = int(np.argmax(np.abs(robot.record(impulse, laboratory.robot, linear=True))))
    meta = {"room": room_name, "rt60": room.rt60_s, "voice": voice, "speaker": human_clip.speaker}
    meta |= {"text": human_clip.text, "start": start, "end": end, **script, **scores, "nl_db": nl_db}
    meta |= {"live": kind == "live", "delay": delay, "seed": [seed, index]}
    fan = signals.pop("fan")
    return Scene({"ref": ref, **signals}, meta, robot, room.robot, gain, fan)


def make_script(rng: Rng, kind: str, voice: list[Clip], human_size: int) -> tuple[dict, Array]:
    """Meta entries (and the human's `onset` before converter delay) and ref (n,)."""
    wait, pause, lead = (int(s * RATE) for s in (rng.uniform(0.5, 1.6), rng.uniform(0.5, 1.1), 0.45))
    first, said = read_utterance(rng, voice, 4.0)
    second, said_then = read_utterance(rng, voice, (wait + human_size) / RATE + rng.uniform(0.3, 1.0))
    first, second = (0.7 * speech / max(np.abs(first).max(), np.abs(second).max()) for speech in (first, second))
    lag, lag2, ppm, volume_db = draw_lags(rng, kind, pause)
    t_main = lead + first.size + pause
    ref = np.zeros(t_main + second.size + max(lag, lag2) + RATE // 2)
    ref[lead : lead + first.size], ref[t_main : t_main + second.size] = first, second
    script = {"lag": lag, "t_main": t_main, "onset": t_main + lag2 + wait}
    script |= {"lag2": lag2, "ppm": ppm, "volume_db": volume_db} if kind == "live" else {}
    placed = ((lead, said), (t_main, said_then))
    return script | {"said": [(text, at + i, at + j) for at, of in placed for text, i, j in of]}, ref


def played(ref: Array, script: dict) -> Array:
    """What the converter plays (n,) of ref (n,): each utterance after its lag, on its own clock, as loud as it was turned."""
    out, at = np.zeros(ref.size), script["t_main"]
    lag, lag2 = script["lag"], script.get("lag2", script["lag"])
    out[lag : lag + at] = ref[:at][: ref.size - lag]
    out[at + lag2 :] += 10 ** (script.get("volume_db", 0.0) / 20) * ref[at : ref.size - lag2]
    return physics.warp(out, script.get("ppm", 0.0))


def noises(rng: Rng, sizes: tuple[int, int, int]) -> list[Array]:
    """Noise of a drawn fan, of unit power, for each size (n,)."""
    spectrum = physics.draw_fan(rng)
    return [physics.fan_noise(rng, spectrum, n) for n in sizes]


def record_all(
    rng: Rng,
    room_name: str,
    robot: Robot,
    paths: tuple[Array, Array],
    played: Array,
    clean: Array,
    span: slice | Array,
    fans: Callable[[Rng, tuple[int, int, int]], list[Array]],
) -> tuple[dict[str, Array], dict[str, float], float]:
    """Calibration in the first path's room, conversation in the second's, with all levels set; their figures; the gain.

    The gain makes the sweep peak at 0.22-0.42 of full scale; the human is scaled to the unfiltered SI-SDR, the fan to
    4.5-10.5 dB below the human; of an array (microphones, n) in the first microphone. fans: with the sweep, alone, and in
    the conversation, of unit power. span: where the human speaks.
    """
    excitation = physics.sweep()
    sweep_echo = robot.record(excitation, paths[0])
    gain = rng.uniform(0.22, 0.42) / np.abs(sweep_echo).max()
    echo = robot.record(played, paths[1])
    echo_gain = gain * min(1.0, 0.9 / np.abs(gain * echo).max())
    echo *= echo_gain
    mean, deviation = UNFILTERED_DB[room_name]
    target_db = mean + deviation * np.clip(rng.standard_normal(), -2, 2)
    said, heard = (np.atleast_2d(x)[0, span] for x in (clean, echo))
    clean = clean * math.sqrt(np.mean(heard**2) / np.mean(said**2)) * 10 ** (target_db / 20)
    snr_fan = rng.uniform(4.5, 10.5)
    said = np.atleast_2d(clean)[0, span]
    level = math.sqrt(np.mean(said**2)) * 10 ** (-snr_fan / 20)
    fan = [level * noise for noise in fans(rng, (excitation.size, 8 * RATE, clean.shape[-1]))]
    mic = echo + clean + fan[2]
    signals = {"sweep_ref": excitation, "sweep_mic": gain * sweep_echo + fan[0], "fan_only": fan[1]}
    signals |= {"mic": mic, "clean": clean, "fan": fan[2]}
    return signals, {"snr_fan": snr_fan, "sisdr_mix": si_sdr(np.atleast_2d(mic)[0, span], said)}, echo_gain


def write_item(folder: Path, signals: dict[str, Array], name: str, about: dict) -> None:
    """The signals (n,) or (n, channels) as FLAC and NAME.json into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for signal_name, samples in signals.items():
        sf.write(folder / f"{signal_name}.flac", samples, RATE, subtype="PCM_16")
    (folder / f"{name}.json").write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--speech", type=Path, required=True, metavar="DIR", help="human speech")
    parser.add_argument("--voices", type=Path, required=True, nargs="+", metavar="DIR", help="the robot's voices")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--kind", choices=("paper", "live"), required=True)
    parser.add_argument("--distortion", choices=tuple(DISTORTION_DB), default="moderate", help="of the loudspeaker")
    parser.add_argument(
        "--microphone", choices=tuple(MICROPHONES), help="what else it does or hears, see microphones.py"
    )
    parser.add_argument("--count", type=int, default=24)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    speech = read_clips(options.speech, (3.0, 12.0))
    voices = read_voices(options.voices)
    for index in tqdm(range(options.count), unit="conversation", desc=str(options.output)):
        scene = make_scene(options.seed, index, options.kind, speech, voices, options.distortion, options.microphone)
        write_item(options.output / f"{scene.meta['room']}_{index:02d}", scene.signals, "meta", scene.meta)


if __name__ == "__main__":
    main()
