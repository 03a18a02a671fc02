r"""Simulate conversations with a robot that has several microphones.

    python -m bench.simulate.arrays --speech human/val --voices robot/val --noise array --kind paper --room office \
        --count 12 --seed 1 --output DIR

As bench.simulate.conversations makes them, whose levels, rooms, loudspeakers and lags these have, with all microphones in
the channels of one file: sweep_mic, fan_only, mic and clean are (n, microphones), FLAC. The microphones stand on a circle
of 2.5 to 4.5 cm around the place of the one microphone there, with gains up to 1 dB apart and a shell of their own. The
robot speaks --turns times after its first utterance, and the same human interrupts each time, from the same place;
meta.json lists the turns (start, end, text, moved), and start, end and text are the first one's. --moving: the human
speaks each turn from another place. --no-echo: the same conversations with a robot that is silent, ref of zeros, so that what is
left beside the human is the fan.

The fan: --noise is a folder of recordings of a robot's own noise with an array in channels 1 to 3; every second file is
for the calibration, the others for the conversation. Their covariances, bin by bin, colour the noise of a drawn spectrum.
A fourth microphone has with the others what the third has with the first two, at another phase. --fan parts needs no
recording: near sources below the microphones, a diffuse part and each microphone's own, in drawn shares.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import soundfile as sf
from scipy import signal
from tqdm import tqdm

from bench.simulate import conversations
from bench.simulate import simulated_robot as physics
from bench.simulate.conversations import Clip, Voices, read_speech, read_utterance, record_all, write_item
from bench.simulate.simulated_robot import RATE, SOUND_M_S, Array, Rng
from edgefilter.dsp.metrics import si_sdr

SIZE = 512
"""Samples of a frame of the covariances: finer than the fan's coherence changes."""


def measured_covariances(folder: Path) -> tuple[Array, Array]:
    """Covariances of the array's noise for the calibration and for the conversation, from different files, (bins, 3, 3) each."""
    files = sorted(folder.glob("*.flac"))
    if len(files) < 2:
        sys.exit(f"{folder} holds {len(files)} FLAC files, expected at least two of an array's own noise")
    halves = []
    for own in (files[::2], files[1::2]):
        found = 0.0
        for file in own:
            samples, rate = sf.read(file)
            if rate != RATE or samples.ndim != 2 or samples.shape[1] < 4:
                wanted = f"expected {RATE} Hz and an array in channels 1-3"
                sys.exit(f"{file} has {rate} Hz and shape {samples.shape}, {wanted}")
            x = samples.T[1:4] / samples[:, 1:4].std()
            found = found + signal.csd(x[None], x[:, None], fs=RATE, nperseg=SIZE)[1].transpose(2, 0, 1)
        halves.append(found / len(own))
    return halves[0], halves[1]


def with_microphones(covariance: Array, count: int, phase: float) -> Array:
    """Covariances of one to four microphones from those of three, (bins, count, count); phase: of the fourth at 8 kHz."""
    if count <= 3:
        return covariance[:, :count, :count]
    total = np.trace(covariance, axis1=1, axis2=2)[:, None, None].real
    root = np.linalg.cholesky(covariance + 1e-6 * total * np.eye(3))
    turn = np.exp(1j * phase * np.arange(len(covariance)) / len(covariance))
    mixed = root[:, 2, [2, 0, 1]] * turn[:, None]
    out = np.zeros((len(covariance), 4, 4), complex)
    out[:, :3, :3], out[:, 3, :3] = root, 0.7 * mixed
    out[:, 3, 3] = math.sqrt(1 - 0.7**2) * np.linalg.norm(mixed, axis=1)
    return out @ out.conj().transpose(0, 2, 1)


def parts_covariance(rng: Rng, places: Array) -> Array:
    """Covariance of near sources, a diffuse field and the microphones' own noise, (bins, m, m). places: (m, 3) m."""
    hz = np.arange(SIZE // 2 + 1) * RATE / SIZE
    wave = 2 * np.pi * hz / SOUND_M_S
    count = len(places)
    total = np.zeros((hz.size, count, count), complex)
    for _ in range(3):
        source = np.array([*rng.uniform(-0.1, 0.1, 2), rng.uniform(-0.2, -0.06)])
        distance = np.linalg.norm(places - source, axis=1)
        heard = np.exp(-1j * wave[:, None] * distance) / distance
        total += rng.uniform(0.3, 1.0) * np.einsum("fi,fj->fij", heard, heard.conj())
    total /= np.trace(total, axis1=1, axis2=2).real[:, None, None] / count
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    diffuse = np.sinc(wave[:, None, None] * apart / np.pi)
    share, own = rng.uniform(0.1, 0.4), rng.uniform(0.01, 0.05)
    return (1 - share - own) * total + share * diffuse + own * np.eye(count)


def coloured(rng: Rng, covariance: Array, amplitude: Array, n: int) -> Array:
    """Gaussian noise of that covariance in each bin, amplitude (1025,) on 0 to 8 kHz, unit power in channel 0, (m, n)."""
    count = covariance.shape[1]
    scale = covariance / covariance[:, :1, :1].real  # channel 0 has the drawn spectrum
    root = np.linalg.cholesky(scale + 1e-6 * np.eye(count))
    at = np.linspace(0, 1, root.shape[0])
    root = root * np.interp(at, np.linspace(0, 1, amplitude.size), amplitude)[:, None, None]
    hop = SIZE // 2
    frames = n // hop + 3
    window = np.sqrt(signal.windows.hann(SIZE, sym=False))
    spectra = rng.standard_normal((frames, root.shape[0], count, 2)) @ np.array([1, 1j]) * math.sqrt(SIZE / 2)
    sound = np.fft.irfft(np.einsum("fij,tfj->tif", root, spectra), SIZE) * window
    out = np.zeros((count, (frames + 1) * hop))
    for index, frame in enumerate(sound):
        out[:, index * hop : index * hop + SIZE] += frame
    out = out[:, hop : hop + n]
    return out / math.sqrt(np.mean(out[0] ** 2))


def draw_places(rng: Rng, count: int) -> Array:
    """Places of microphones on a circle, (count, 3) in m."""
    radius, first = rng.uniform(0.025, 0.045), rng.uniform(0, 2 * np.pi)
    angles = first + 2 * np.pi * np.arange(count) / max(count, 3)
    return radius * np.stack((np.cos(angles), np.sin(angles), np.zeros(count)), axis=1)


def make_script(rng: Rng, kind: str, voice: list[Clip], humans: list[Array]) -> tuple[dict, Array]:
    """Where everything happens, and ref (n,): an utterance alone, then one for each human's turn."""
    utterances, waits = [read_utterance(rng, voice, 4.0)[0]], []
    for human in humans:
        waits.append(rng.uniform(0.5, 1.6))
        utterances.append(read_utterance(rng, voice, waits[-1] + human.size / RATE + rng.uniform(0.3, 1.0))[0])
    peak = max(np.abs(one).max() for one in utterances)
    lag = rng.uniform(0.05, 0.3)
    live = kind == "live"
    ppm = rng.choice([-1.0, 1.0]) * math.exp(rng.uniform(math.log(10), math.log(300))) if live else 0.0
    parts, spoken, at = [], [], int(0.45 * RATE)
    for index, one in enumerate(utterances):
        if live and index:
            lag = rng.uniform(0.0, 1.2)
        volume_db = rng.uniform(-3, 3) if live and index else 0.0
        parts.append({"at": at, "size": one.size, "lag": int(lag * RATE), "volume_db": volume_db})
        if index:
            spoken.append(at + parts[-1]["lag"] + int(waits[index - 1] * RATE))
        at += one.size + int(rng.uniform(0.5, 1.1) * RATE) + (int(1.2 * RATE) if live or index else 0)
    ref = np.zeros(at + int(1.5 * RATE))
    for part, one in zip(parts, utterances):
        ref[part["at"] : part["at"] + one.size] = 0.7 * one / peak
    return {"parts": parts, "ppm": ppm, "onsets": spoken}, ref


def played(ref: Array, script: dict) -> Array:
    """What the converter plays (n,) of ref (n,)."""
    out = np.zeros(ref.size)
    for part in script["parts"]:
        begin, size = part["at"], part["size"]
        out[begin + part["lag"] :][:size] += 10 ** (part["volume_db"] / 20) * ref[begin : begin + size]
    return physics.warp(out, script["ppm"])


def make(
    seed: int,
    index: int,
    kind: str,
    room_name: str,
    speech: list[Clip],
    voices: Voices,
    covariances: tuple[Array, Array] | None,
    microphones: int = 4,
    turns: int = 2,
    moving: bool = False,
    echo: bool = True,
) -> tuple[dict[str, Array], dict]:
    """Item index of this seed: signals, (n, microphones) but for sweep_ref and ref, and the contents of meta.json."""
    rng = np.random.default_rng([seed, index, 36])
    speakers = sorted({clip.speaker for clip in speech})
    speaker = speakers[np.random.default_rng(seed).permutation(len(speakers))[index % len(speakers)]]
    own = [clip for clip in speech if clip.speaker == speaker]
    said = [own[i] for i in rng.permutation(len(own))[:turns]]
    humans = [read_speech(clip) for clip in said]
    voice = str(rng.choice(sorted(voices)))
    robot, places, human_m = physics.draw_robot(rng), draw_places(rng, microphones), rng.uniform(1.0, 1.5)
    robot = replace(robot, shell=np.stack([physics.draw_body(rng) for _ in range(microphones)]))
    gains = 10 ** (np.concatenate(([0.0], rng.uniform(-1, 1, microphones - 1))) / 20)
    about = robot.distance_m, robot.direction, human_m, places
    laboratory = physics.stand(rng, physics.draw_walls(rng, "lab"), *about)
    moves = turns - 1 if moving else 0
    room = physics.stand(rng, physics.draw_walls(rng, room_name), *about, moves)
    heard = [room.human, *(room.elsewhere or [room.human] * (turns - 1))]
    script, ref = make_script(rng, kind, voices[voice], humans)
    sound = played(ref, script)
    one = replace(robot, shell=robot.shell[0])
    wanted_db = rng.uniform(*conversations.DISTORTION_DB["moderate"][room_name])
    driven, nl_db = physics.with_distortion(one, sound, room.robot[0], wanted_db)
    robot = replace(robot, loudspeaker=driven.loudspeaker)
    clean, spans = np.zeros((microphones, ref.size)), []
    for human, response, onset in zip(humans, heard, script.pop("onsets")):
        start = onset + robot.bulk
        voiced = signal.oaconvolve(human[None], response, axes=-1)[:, : ref.size - start]
        clean[:, start : start + voiced.shape[1]] += voiced
        spans.append((start, min(start + human.size + RATE // 10, ref.size)))
    inside = np.zeros(ref.size, bool)
    for begin, end in spans:
        inside[begin:end] = True

    def fans(rng: Rng, sizes: tuple[int, int, int]) -> list[Array]:
        spectrum, phase = physics.draw_fan(rng), rng.uniform(-20, 20)
        if covariances is None:
            calibrated = conversing = parts_covariance(rng, places)
        else:
            calibrated, conversing = (with_microphones(one, microphones, phase) for one in covariances)
        return [coloured(rng, of, spectrum, n) for of, n in zip((calibrated, calibrated, conversing), sizes)]

    paths = (laboratory.robot, room.robot)
    signals, scores, _ = record_all(rng, room_name, robot, paths, sound, clean, inside, fans)
    fan = signals.pop("fan")
    if not echo:
        signals["mic"], ref = signals["clean"] + fan, np.zeros(ref.size)
        scores["sisdr_mix"] = si_sdr(signals["mic"][0, inside], signals["clean"][0, inside])
    excitation = signals.pop("sweep_ref")
    signals = {"sweep_ref": excitation, **{name: (gains[:, None] * of).T for name, of in signals.items()}}
    meta = {"room": room_name, "rt60": room.rt60_s, "voice": voice, "speaker": speaker, "text": said[0].text}
    meta |= {"start": spans[0][0], "end": spans[0][1], "t_main": script["parts"][1]["at"], "kind": kind}
    meta |= {"turns": [{"start": a, "end": b, "text": clip.text, "moved": moving and i > 0}
                       for i, ((a, b), clip) in enumerate(zip(spans, said))]}  # fmt: skip
    meta |= {**script, **scores, "nl_db": nl_db, "places": places.tolist(), "seed": [seed, index]}
    return {"ref": ref, **signals}, meta


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--speech", type=Path, required=True, metavar="DIR", help="human speech")
    add("--voices", type=Path, required=True, nargs="+", metavar="DIR", help="the robot's voices")
    add("--noise", type=Path, metavar="DIR", help="an array's own noise; without it the fan is of parts")
    add("--no-echo", action="store_true", help="the robot is silent")
    add("--output", type=Path, required=True, metavar="DIR")
    add("--kind", choices=("paper", "live"), required=True)
    add("--room", choices=("lab", "office", "both"), default="both", help="both: in turn")
    add("--microphones", type=int, choices=(1, 2, 3, 4), default=4)
    add("--turns", type=int, default=2, help="of the human")
    add("--moving", action="store_true", help="the human speaks each turn from another place")
    add("--count", type=int, default=12)
    add("--seed", type=int, default=1)
    options = parser.parse_args()
    speech, voices = conversations.read_clips(options.speech, (3.0, 8.0)), conversations.read_voices(options.voices)
    covariances = measured_covariances(options.noise) if options.noise else None
    for index in tqdm(range(options.count), unit="conversation", desc=str(options.output)):
        room = ("lab", "office")[index % 2] if options.room == "both" else options.room
        signals, meta = make(options.seed, index, options.kind, room, speech, voices, covariances, options.microphones,
                             options.turns, options.moving, echo=not options.no_echo)  # fmt: skip
        write_item(options.output / f"{room}_{index:02d}", signals, "meta", meta)


if __name__ == "__main__":
    main()
