"""`edgefilter demo --hidden`: bundled robots to which something has happened: compared, diagnosed, mended, filtered."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import soundfile

from edgefilter.audio.files import FileSink
from edgefilter.commands.display import report_part, write_json
from edgefilter.commands.fitting import fit
from edgefilter.diagnosis.diagnose import Diagnosis, diagnose
from edgefilter.dsp.metrics import si_sdr
from edgefilter.errors import UsageError
from edgefilter.filter.enhance import enhance
from edgefilter.profile.data import Profile
from edgefilter.report.text import in_order
from edgefilter.report.words import decibels, headline
from edgefilter.types import SAMPLE_RATE, Samples

DATA = Path(__file__).parents[1] / "demo_data"
CASES = ("one", "two")
"""Folders of demo_data/hidden: with one hidden effect, and with two."""
HUMAN_DB, HUMAN_AT_S = -20.0, 1.0
"""Level of the human re the robot in the same seconds, and when the human begins to interrupt."""


@dataclass(frozen=True, eq=False)
class Case:
    """A bundled robot: its profile from before something happened, and recordings (n,) from after.

    mic, reference: the robot alone. talk, talk_reference: the robot interrupted by a human. human: the human alone.
    """

    profile: Profile
    mic: Samples
    reference: Samples
    talk: Samples
    talk_reference: Samples
    human: Samples
    truth: dict[str, Any]


def main(args: argparse.Namespace) -> int:
    figures = {}
    for name in CASES:
        figures[name] = _tell(name, Path(args.output) / name, args.engine, quiet=args.json == "-")
    if args.json:
        write_json({"schema": 1, **figures}, args.json)
    return 0


def load(name: str) -> Case:
    """The bundled case of that name, the demo's human mixed into its end."""
    folder = DATA / "hidden" / name
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    mic, reference = (_read(folder / f"{file}.flac") for file in ("mic", "reference"))
    at, begin = round(truth["talk_s"] * SAMPLE_RATE), round(HUMAN_AT_S * SAMPLE_RATE)
    heard = mic[at:]
    voice = _read(DATA / "human.flac")
    spoken = np.flatnonzero(voice)
    voice = voice[spoken[0] : spoken[-1] + 1][: heard.size - begin]
    level = np.sqrt(np.mean(heard[begin : begin + voice.size] ** 2) / np.mean(voice**2)) * 10 ** (HUMAN_DB / 20)
    human = np.zeros_like(heard)
    human[begin : begin + voice.size] = np.float32(level) * voice
    profile = Profile.load(folder / "profile.npz")
    return Case(profile, mic[:at], reference[:at], heard + human, reference[at:], human, truth)


def _tell(name: str, folder: Path, engine: str, quiet: bool) -> dict[str, object]:
    """One case from its recordings to the mended filter: written, drawn and told."""
    case = load(name)
    files = _write_input(folder, case)
    found = diagnose(case.profile, case.mic, case.reference)
    names = tuple(finding.effect for finding in in_order(found.ranking))
    applied = fit(case.profile, case.profile, names, case.mic, case.reference, force=False, drop=True)
    applied.profile.save(folder / "better.npz")
    filtered = {
        kept: enhance(case.talk, case.talk_reference, profile, engine)
        for kept, profile in (("before", case.profile), ("after", applied.profile))
    }
    for kept, samples in filtered.items():
        _write(folder / f"human_{kept}.wav", samples)
    figures = _figures(case, found, filtered) | {"applied": applied.to_dict()}
    drawn = _draw(folder, case, found, filtered)
    if not quiet:
        made = [*files, "better.npz", "human_before.wav", "human_after.wav", *drawn]
        print("\n".join(_lines(name, folder, case, found, applied.lines(), figures, made)))
    return figures


def _figures(case: Case, found: Diagnosis, filtered: dict[str, Samples]) -> dict[str, Any]:
    speaking = np.flatnonzero(case.human)
    span = slice(speaking[0], speaking[-1] + 1)
    return {
        "hidden": case.truth["effects"],
        "named": [finding.effect for finding in found.ranking],
        "excess_before_db": found.comparison.excess_db,
        "excess_after_db": found.remaining_db,
        "si_sdr_microphone_db": si_sdr(case.talk[span], case.human[span]),
        **{f"si_sdr_{kept}_db": si_sdr(samples[span], case.human[span]) for kept, samples in filtered.items()},
    }


def _lines(
    name: str, folder: Path, case: Case, found: Diagnosis, applied: list[str], figures: dict[str, Any], files: list[str]
) -> list[str]:
    """The story with the commands that would tell it again."""
    given = f"--profile {folder}/robot.npz --recording {folder}/mic.wav --reference {folder}/tts.wav"
    run = f"edgefilter run --input {folder}/talk.wav --reference {folder}/talk_tts.wav --profile {folder}"
    said = [finding.effect for finding in found.ranking]
    sdr = {key: f"{figures[f'si_sdr_{key}_db']:.1f} dB" for key in ("microphone", "before", "after")}
    return [
        f"robot {name}: something happened to it after its calibration (simulated)",
        f"$ edgefilter compare {given}",
        f"  its own voice is {decibels(found.comparison.excess_db)} dB over the noise floor after the prediction",
        f"$ edgefilter diagnose {given} --apply {folder}/better.npz --report {folder}/report.html",
        f"  {headline(found.verdict, said)}",
        *(f"  {line}" for line in applied[:1] + [line for line in applied if line.startswith("proof")]),
        f"$ {run}/better.npz --output {folder}/human_after.wav",
        f"  SI-SDR of the human who interrupts it: {sdr['microphone']} at the microphone, {sdr['before']} with the"
        f" profile as it was, {sdr['after']} with better.npz",
        f"hidden was: {', '.join(case.truth['effects'])}",
        f"files in {folder}: {', '.join(files)}",
        "",
    ]


def _write_input(folder: Path, case: Case) -> list[str]:
    """What the commands would be given, under the names by which the story calls it."""
    folder.mkdir(parents=True, exist_ok=True)
    case.profile.save(folder / "robot.npz")
    signals = {"mic": case.mic, "tts": case.reference, "talk": case.talk, "talk_tts": case.talk_reference}
    for name, samples in signals.items():
        _write(folder / f"{name}.wav", samples)
    return ["robot.npz", *(f"{name}.wav" for name in signals)]


def _draw(folder: Path, case: Case, found: Diagnosis, filtered: dict[str, Samples]) -> list[str]:
    """The page of the diagnosis, and the conversation before and after; nothing where what draws is not installed."""
    try:
        html, plots = report_part("html"), report_part("plots")
    except UsageError as error:
        print(f"no page and no picture: {error}", file=sys.stderr)
        return []
    names = {"profile": "robot.npz", "recording": "mic.wav", "reference": "tts.wav", "effects": []}
    page = html.diagnosis_page(case.profile, found, case.mic, case.reference, names)
    html.write_page(folder / "report.html", page)
    signals = {
        "microphone: the robot, and a human who interrupts it": case.talk,
        "filtered with the profile as it was": filtered["before"],
        "filtered with what the diagnosis added": filtered["after"],
        "the human alone": case.human,
    }
    plots.plot_before_after(signals, folder / "before_after.png")
    return ["report.html", "before_after.png"]


def _read(path: Path) -> Samples:
    return soundfile.read(path, dtype="float32")[0]


def _write(path: Path, samples: Samples) -> None:
    with FileSink(path) as sink:
        sink.write(samples)
