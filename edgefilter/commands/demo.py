"""`edgefilter demo`: the bundled (simulated) conversation, filtered, drawn and measured."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import soundfile

from edgefilter.audio.files import FileSink, FileSource
from edgefilter.commands import hidden
from edgefilter.commands.display import describe_latency, write_json
from edgefilter.dsp.metrics import si_sdr
from edgefilter.engines import NEEDS_PROFILE
from edgefilter.filter.ego_filter import EgoFilter
from edgefilter.filter.enhance import enhance
from edgefilter.session import filter_blocks
from edgefilter.types import SAMPLE_RATE, Samples

DATA = Path(__file__).parents[1] / "demo_data"


def main(args: argparse.Namespace) -> int:
    if args.hidden:
        return hidden.main(args)
    folder = Path(args.output)
    folder.mkdir(parents=True, exist_ok=True)
    ego = EgoFilter(DATA / "profile.npz", args.engine)
    filtered = folder / "filtered.wav"
    with FileSource(DATA / "mic.flac", DATA / "reference.flac") as source, FileSink(filtered) as sink:
        report = filter_blocks(source, ego, sink)
    if report.failure:
        raise report.failure
    figures = report.to_dict() | scores(_read(filtered), args.engine)
    files = [filtered, *_copy_input(folder), *_draw(folder, filtered)]
    if args.json:
        write_json(figures, args.json)
    if args.json != "-":
        print(
            f"a simulated robot talks, a human interrupts; filtered with engine {ego.engine_name}"
            f" ({report.process_s / (report.samples_in / SAMPLE_RATE):.3f} of real time,"
            f" {describe_latency(ego)})\nSI-SDR of the human: {figures['si_sdr_before_db']:.1f} dB before,"
            f" {figures['si_sdr_after_db']:.1f} dB after with the robot's calibration{_without(figures)}\nfiles:"
            f" {', '.join(str(file) for file in files)}"
        )
    return 0


def scores(filtered: Samples, engine: str) -> dict[str, float | None]:
    """SI-SDR over the stretch in which the human speaks: before, after, and after without the calibration where the engine can do so."""
    human, mic, ref = (_read(DATA / f"{name}.flac") for name in ("human", "mic", "reference"))
    speaking = np.flatnonzero(human)
    span = slice(speaking[0], speaking[-1] + 1)
    cold = None if engine in NEEDS_PROFILE else si_sdr(enhance(mic, ref, None, engine)[span], human[span])
    return {
        "si_sdr_before_db": si_sdr(mic[span], human[span]),
        "si_sdr_after_db": si_sdr(filtered[span], human[span]),
        "si_sdr_after_uncalibrated_db": cold,
    }


def _without(figures: dict) -> str:
    cold = figures["si_sdr_after_uncalibrated_db"]
    return "" if cold is None else f", {cold:.1f} dB uncalibrated"


def _read(path: Path) -> Samples:
    return soundfile.read(path, dtype="float32")[0]


def _copy_input(folder: Path) -> list[Path]:
    before, human = folder / "microphone.wav", folder / "human.wav"
    for source, target in ((DATA / "mic.flac", before), (DATA / "human.flac", human)):
        with FileSink(target) as sink:
            sink.write(_read(source))
    return [before, human]


def _draw(folder: Path, filtered: Path) -> list[Path]:
    try:
        from edgefilter.report.plots import plot_before_after
    except ModuleNotFoundError as error:
        print(f"no picture: {error.name} is not installed (pip install 'edgefilter[report]')", file=sys.stderr)
        return []
    picture = folder / "before_after.png"
    signals = {
        "microphone": _read(DATA / "mic.flac"),
        "filtered": _read(filtered),
        "the human alone": _read(DATA / "human.flac"),
    }
    plot_before_after(signals, picture)
    return [picture]
