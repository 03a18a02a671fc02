"""`edgefilter demo`: a bundled (simulated) conversation, filtered; or robots that have changed, diagnosed and mended."""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import soundfile

from edgefilter.audio.files import FileSink, FileSource, write_file
from edgefilter.closed_loop import ASK_DB, closed_loop
from edgefilter.commands.add import Fitted, fit
from edgefilter.commands.display import describe_latency, print_result, progress, report_part, say
from edgefilter.commands.outputs import CASES
from edgefilter.diagnosis.recording import Recording
from edgefilter.diagnosis.result import in_order
from edgefilter.dsp.metrics import si_sdr
from edgefilter.engines import NEEDS_PROFILE
from edgefilter.errors import UsageError
from edgefilter.filter.barge_in import BargeInSettings
from edgefilter.filter.budget import DEMO
from edgefilter.filter.ego_filter import EgoFilter, enhance
from edgefilter.profile.data import Profile
from edgefilter.report.text import decibels, first_sight_line, headline
from edgefilter.session import filter_blocks
from edgefilter.types import SAMPLE_RATE, Samples

HUMAN_DB, HUMAN_AT_S = -20.0, 1.0
"""Level of the human relative to the robot while both speak, dB, and when the human begins, s from the start."""


def main(args: argparse.Namespace) -> None:
    if args.hidden:
        figures = {name: _mend(name, Path(args.output) / name, args) for name in CASES}
        print_result(args, [], {"schema": 1, **figures})
    else:
        _filter(args)


def _filter(args: argparse.Namespace) -> None:
    """Filter the bundled conversation, measure it, draw it, and print what came of it."""
    folder = Path(args.output)
    folder.mkdir(parents=True, exist_ok=True)
    with progress("demo: filtering the bundled conversation") as step:
        ego = EgoFilter(DEMO / "profile.npz", engine=args.engine)
        output = folder / "filtered.wav"
        with FileSource(DEMO / "mic.flac", DEMO / "reference.flac") as source, FileSink(output) as sink:
            report = filter_blocks(source, ego, sink, due=False)
        if report.failure:
            raise report.failure
        step("again without the robot's calibration")
        mic, reference, human = (_read(DEMO / f"{name}.flac") for name in ("mic", "reference", "human"))
        filtered = _read(output)
        cold = (
            None if args.engine in NEEDS_PROFILE else _si_sdr(enhance(mic, reference, None, engine=args.engine), human)
        )
        figures = report.to_dict() | {
            "si_sdr_before_db": _si_sdr(mic, human),
            "si_sdr_after_db": _si_sdr(filtered, human),
            "si_sdr_after_uncalibrated_db": cold,
        }
        step("again, with a robot that lowers its voice to listen, and stops")
        sounds = {"microphone.wav": mic, "human.wav": human, "interrupted.wav": interrupted(mic, reference)}
        step("drawing")
        for name, sound in sounds.items():
            write_file(folder / name, sound)
        files = ["filtered.wav", *sounds]
        if plots := _drawer("plots"):
            drawn = {
                "what the microphone hears: the robot talks, its fan runs, a human interrupts": mic,
                "filtered: what edgefilter leaves of it": filtered,
                "the human alone, for comparison": human,
            }
            plots.plot_before_after(drawn, folder / "before_after.png")
            files.append("before_after.png")
    begun, ended = (at / SAMPLE_RATE for at in (speaking(human).start, speaking(human).stop))
    without = "" if cold is None else f", {cold:.1f} dB without it"
    lines = [
        f"a simulated robot talks, a human interrupts; filtered with engine {ego.engine_name}"
        f" ({report.process_s / (report.samples_in / SAMPLE_RATE):.3f} of real time, {describe_latency(ego)})",
        f"SI-SDR of the human: {figures['si_sdr_before_db']:.1f} dB before, {figures['si_sdr_after_db']:.1f} dB after"
        f" with the robot's calibration{without}",
        f"listen to microphone.wav, in which the robot hides the human, who speaks from {begun:.0f} to {ended:.0f} s; then to"
        " filtered.wav, from which the robot is gone; human.wav is the human alone, interrupted.wav what people hear of a robot"
        " that lowers its voice when somebody may interrupt it, and stops when it is so",
        f"files: {', '.join(str(folder / file) for file in files)}",
    ]
    print_result(args, lines, figures)


def interrupted(mic: Samples, reference: Samples) -> Samples:
    """The bundled conversation at the microphone (n,), had the robot lowered its voice where the filter asks, and stopped for the human."""
    known = EgoFilter(DEMO / "profile.npz", engine="linear", keep_channels=True)
    known.process(mic, reference)
    left, stats = known.robot_removed()[:, 0], known.stats()["alignment"]  # whole hops
    lag = round(stats["delay_samples"] or 0) if stats else 0
    ego = EgoFilter(DEMO / "profile.npz", engine="crnn", barge_in=BargeInSettings(ask_db=ASK_DB))
    heard, played = mic[: left.size].copy(), reference[: left.size].copy()
    for _ in closed_loop(ego, heard, played, heard - left, lag, stops=True):
        pass
    return heard


@dataclass(frozen=True, eq=False)
class Case:
    """A bundled robot: its profile from before something happened to it, and recordings (n,) from after.

    mic, reference: the robot alone. talk, talk_reference: the robot interrupted by a human. human: the human alone.
    """

    profile: Profile
    mic: Samples
    reference: Samples
    talk: Samples
    talk_reference: Samples
    human: Samples
    truth: dict[str, Any]


def load(name: str) -> Case:
    """The bundled robot of that name; the demo's human is mixed into the last seconds of its recording."""
    folder = DEMO / "hidden" / name
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    mic, reference = (_read(folder / f"{file}.flac") for file in ("mic", "reference"))
    at, begin = round(truth["talk_s"] * SAMPLE_RATE), round(HUMAN_AT_S * SAMPLE_RATE)
    robot, voice = mic[at:], _read(DEMO / "human.flac")
    voice = voice[speaking(voice)][: robot.size - begin]
    level = np.sqrt(np.mean(robot[begin : begin + voice.size] ** 2) / np.mean(voice**2)) * 10 ** (HUMAN_DB / 20)
    human = np.zeros_like(robot)
    human[begin : begin + voice.size] = np.float32(level) * voice
    profile = Profile.load(folder / "profile.npz")
    return Case(profile, mic[:at], reference[:at], robot + human, reference[at:], human, truth)


def _mend(name: str, folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    """One robot from its recordings to the mended filter: written and drawn, and told with the commands that do it."""
    case = load(name)
    folder.mkdir(parents=True, exist_ok=True)
    case.profile.save(folder / "robot.npz")
    given = {"mic": case.mic, "tts": case.reference, "talk": case.talk, "talk_tts": case.talk_reference}
    for file, samples in given.items():
        write_file(folder / f"{file}.wav", samples)
    files = f"--profile {folder}/robot.npz --recording {folder}/mic.wav --reference {folder}/tts.wav"
    made = f"--apply {folder}/better.npz --report {folder}/report.html"
    changed = f"robot {name}: something about it has changed since its calibration (simulated)"
    print_result(args, [changed, f"$ edgefilter compare {files}"])
    with progress(f"robot {name}: comparison"):
        recording = Recording(case.mic, case.reference, case.profile)
        excess_db, seen = recording.compare().excess_db, first_sight_line(recording.at_first_sight())
    excess = f"  its own voice is {decibels(excess_db)} dB over the noise floor after the prediction"
    print_result(args, [excess, f"$ edgefilter diagnose {files} {made}", f"  {seen}"])
    with progress(f"robot {name}: diagnosis") as step:
        found = recording.diagnose(progress=step)
        step("fit of what was found, and proof in the running filter")
        names = tuple(finding.effect for finding in in_order(found.ranking))
        applied = fit(recording, names, force=False, found=found)
        applied.profile.save(folder / "better.npz")
    named = [finding.name for finding in found.ranking]
    added, *more = applied.lines()
    told = [headline(found.verdict, named), added, *(line for line in more if line.startswith("proof"))]
    run = f"edgefilter run --input {folder}/talk.wav --reference {folder}/talk_tts.wav --profile {folder}"
    print_result(args, [*(f"  {line}" for line in told), f"$ {run}/better.npz --output {folder}/human_after.wav"])
    filtered = {}
    with progress(f"robot {name}: conversation") as step:
        for kept, profile, which in (("before", case.profile, "old"), ("after", applied.profile, "mended")):
            step(f"filtering with the {which} profile")
            filtered[kept] = enhance(case.talk, case.talk_reference, profile, engine=args.engine)
            write_file(folder / f"human_{kept}.wav", filtered[kept])
        step("drawing the page and the picture")
        drawn = _draw_mended(folder, case, recording, applied, filtered)
    sdr = {"microphone": case.talk, **filtered}
    figures = {
        "hidden": case.truth["effects"],
        "named": named,
        "excess_before_db": excess_db,
        "excess_after_db": applied.after.excess_db,
        **{f"si_sdr_{kept}_db": _si_sdr(samples, case.human) for kept, samples in sdr.items()},
        "applied": applied.to_dict(),
    }
    written = ["robot.npz", *(f"{file}.wav" for file in given), "better.npz", "human_before.wav", "human_after.wav"]
    lines = [
        "  SI-SDR of the human who interrupts it: {si_sdr_microphone_db:.1f} dB at the microphone, {si_sdr_before_db:.1f}"
        " dB with the profile as it was, {si_sdr_after_db:.1f} dB with better.npz".format(**figures),
        "  listen to human_before.wav, in which the robot is still heard beside the human, and to human_after.wav, from which it is removed",
        f"what had been changed: {', '.join(case.truth['effects'])}",
        f"files in {folder}: {', '.join([*written, *drawn])}",
        "",
    ]
    print_result(args, lines)
    return figures


def _draw_mended(
    folder: Path, case: Case, recording: Recording, applied: Fitted, filtered: dict[str, Samples]
) -> list[str]:
    """The page of the diagnosis that was applied, and the conversation before and after."""
    html, plots = _drawer("html"), _drawer("plots")
    if not html or not plots:
        return []
    names = {"profile": "robot.npz", "recording": "mic.wav", "reference": "tts.wav", "apply": "better.npz"}
    page = html.diagnosis_page(recording, applied.found, names, applied.facts(), applied.proof)
    html.write_page(folder / "report.html", page)
    sounds = {
        "microphone: the robot talks, and a human interrupts it": case.talk,
        "filtered with the profile as it was": filtered["before"],
        "filtered with what the diagnosis added": filtered["after"],
        "the human alone, for comparison": case.human,
    }
    plots.plot_before_after(sounds, folder / "before_after.png")
    return ["report.html", "before_after.png"]


def _drawer(name: str) -> ModuleType | None:
    """A part of the report, or None, which is said, where what it needs is not installed: the figures come all the same."""
    try:
        return report_part(name)
    except UsageError as error:
        say(f"not drawn: {error}")
        return None


def speaking(human: Samples) -> slice:
    """From the first to the last sample that is not zero."""
    spoken = np.flatnonzero(human)
    return slice(spoken[0], spoken[-1] + 1)


def _si_sdr(samples: Samples, human: Samples) -> float:
    """SI-SDR, dB, over the time in which the human speaks."""
    span = speaking(human)
    return si_sdr(samples[span], human[span])


def _read(path: Path) -> Samples:
    return soundfile.read(path, dtype="float32")[0]
