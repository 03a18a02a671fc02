"""Proof without labels: what a diagnosis named, applied, and the running filter heard on seconds that nobody looked at.

    python -m bench.measure.proven_names [--cases DIR ...] [--real DIR] [--limit N] --output bench/results/proven_names

--cases: folders as of bench.measure.hidden_effects, each case with its calibration. --real: pairs NAME_lpb and NAME_mic
(WAV or FLAC, 16 kHz) without one, a minute or more cut every PIECE_S, where the shared ones of one device are joined;
their profile is made from the recording, and held against the filter without any. The first three fifths of the robot's
voice are diagnosed; what was named is fitted to them; the filter, engine `linear`, starts anew on the rest, with and
without it. What makes it worse is taken back, as `diagnose --apply` does (kept). A change of the fan is proven by how
far the expected noise is off that of the rest's silences. Events (a jump, a moment's move) do not come again and are
not proven here.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import soundfile as sf

from bench import results_writer
from bench.measure.hidden_effects import SIGNALS, find_cases
from bench.measure.intervals import wilson
from edgefilter.calibration.calibrate import calibrate
from edgefilter.calibration.from_recording import self_calibrate
from edgefilter.diagnosis.diagnose import diagnose
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.proof import WORSE_DB, HeldOut, lasts, proofs_until_kept
from edgefilter.dsp.frames import blocks, decibels, frames
from edgefilter.dsp.psd import floored, periodograms
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.model import EchoModel
from edgefilter.errors import EdgefilterError
from edgefilter.profile.data import Profile
from edgefilter.report.text import in_order
from edgefilter.types import SAMPLE_RATE, Samples

PIECE_S, WHOLE_S = 10, 45
"""Longer recordings than the latter are cut."""
FEWEST_FRAMES, BAND = 6, 20
"""Half-overlapping frames of silence from which on the fan's spectrum can be told, in bands of so many bins of 13.3 Hz."""


@dataclass(frozen=True)
class Row:
    """One recording: what was named in its first part, what was kept, and what that did to the rest.

    erle_db: (before, after) of the running filter; None where there was nothing lasting to prove. noise_db: (before,
    after) how far the expected noise is off, root mean square over frequency. declined: why nothing could be said.
    """

    recording: str
    named: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()
    first_db: tuple[float, float] | None = None
    erle_db: tuple[float, float] | None = None
    noise_db: tuple[float, float] | None = None
    declined: str = ""

    @property
    def rise_db(self) -> float | None:
        """By how much the error fell with what was kept."""
        return None if self.erle_db is None else self.erle_db[1] - self.erle_db[0]


def examine(name: str, profile: Profile | None, y: Samples, x: Samples) -> Row:
    """The row of recording y (n,) of the robot saying x (n,); profile None: one is made from the recording."""
    try:
        cut = HeldOut(profile or self_calibrate(y, x), y, x).cut
        start = profile or self_calibrate(y[:cut], x[:cut])
        found = diagnose(start, y[:cut], x[:cut])
        named = tuple(finding.effect for finding in in_order(found.ranking))
        noise = noise_off_db(start, found.model, y, x, cut) if any(find(e).stage == "noise" for e in named) else None
        kept = tuple(effect for effect in named if lasts(effect))
        if not kept and profile is not None:
            return Row(name, named, noise_db=noise)
        proofs = proofs_until_kept(profile, kept, y, x)
        first, proof = (proofs[0].erle_before_db, proofs[0].erle_after_db), proofs[-1]
        kept = () if proof.worse else proof.effects
        after_db = proof.erle_before_db if proof.worse else proof.erle_after_db
    except EdgefilterError as error:
        return Row(name, declined=str(error))
    return Row(name, named, kept, first, (proof.erle_before_db, after_db), noise)


def noise_off_db(profile: Profile, model: EchoModel, y: Samples, x: Samples, cut: int) -> tuple[float, float] | None:
    """How far the fan of the silences from cut on is off the profile's, and off the model's, dB; None where it never is silent."""
    prepared, size = prepare(profile, y, x), 2 * (profile.noise_psd.size - 1)
    silent = frames((prepared.usable & ~prepared.active)[cut:], size, size // 2).all(axis=1)
    if silent.sum() < FEWEST_FRAMES:
        return None
    heard = _bands_db(np.mean(periodograms(y[cut:], size)[silent], axis=0))
    expected = profile.noise_psd, model.expected_noise(profile.noise_psd)
    before, after = (float(np.sqrt(np.mean((heard - _bands_db(psd)) ** 2))) for psd in expected)
    return before, after


def _bands_db(psd: Samples) -> np.ndarray:
    """(bands,) dB of a PSD (601,)."""
    return np.asarray(decibels(blocks(floored(psd), BAND).mean(axis=1)))


def of_cases(folder: Path, limit: int | None) -> Iterator[Row]:
    """A row for each case of a folder."""
    for case in find_cases(folder, limit):
        signals = {name: sf.read(case / f"{name}.flac", dtype="float32")[0] for name in SIGNALS}
        profile = calibrate(*(signals[name] for name in SIGNALS[:3]))
        yield examine(case.name, profile, signals["mic"], signals["ref"])


def of_real(folder: Path, limit: int | None) -> Iterator[Row]:
    """A row for each pair of a folder, or each piece of it."""
    pairs = sorted(path for path in folder.glob("*_mic.*") if path.suffix in (".wav", ".flac"))
    for path in pairs[:limit]:
        y, x = (
            sf.read(path.with_name(path.name.replace("_mic.", end)), dtype="float32")[0] for end in ("_mic.", "_lpb.")
        )
        n = min(y.size, x.size)
        step = PIECE_S * SAMPLE_RATE if n > WHOLE_S * SAMPLE_RATE else n
        for at in range(0, n - step + 1, step):
            name = path.name.split("_mic.")[0] + (f" from {at // SAMPLE_RATE} s" if step < n else "")
            yield examine(name, None, y[at : at + step], x[at : at + step])


def summarise(rows: list[Row]) -> dict:
    """How often the error fell, stayed and rose with all that was named, and with what was kept."""
    judged = [row for row in rows if row.erle_db is not None and row.first_db is not None]
    summary: dict = {
        "recordings": len(rows),
        "declined": sum(bool(row.declined) for row in rows),
        "judged": len(judged),
    }
    ways: dict[str, Callable[[Row], tuple[float, float]]] = {
        "named": lambda row: row.first_db or (0.0, 0.0),
        "kept": lambda row: row.erle_db or (0.0, 0.0),
    }
    for way, erle in ways.items():
        change = [erle(row)[1] - erle(row)[0] for row in judged]
        fell = sum(db > WORSE_DB for db in change)
        summary[way] = {"fell": fell, "rose": sum(db < -WORSE_DB for db in change)}
        summary[way] |= {"interval": [100 * part for part in wilson(fell, len(judged))]}
        if change:
            summary[way] |= {"median_db": float(np.median(change)), "worst_db": min(change)}
    noise = [row.noise_db for row in rows if row.noise_db is not None]
    return summary | {"noise": {"proven": sum(after < before for before, after in noise), "of": len(noise)}}


def markdown(name: str, rows: list[Row], summary: dict) -> str:
    """One set as a section."""
    lines = [f"## {name}: {len(rows)} recordings, {summary['declined']} declined, {summary['judged']} judged", ""]
    for way, what in (("named", "With all that was named"), ("kept", "With what was kept")):
        s = summary[way]
        if "median_db" in s:
            lines.append(
                f"{what} the error fell in {s['fell']} of {summary['judged']} ({s['interval'][0]:.0f} to"
                f" {s['interval'][1]:.0f} %), by {s['median_db']:.1f} dB in the median, and rose in {s['rose']}"
                f" (worst: {s['worst_db']:+.1f} dB)."
            )
    lines += [f"Changes of the fan: {summary['noise']['proven']} of {summary['noise']['of']} proven.", ""]
    head = ["recording", "named", "kept", "ERLE before, dB", "named", "kept", "noise off, dB"]
    return "\n".join([*lines, *results_writer.table(head, map(_cells, rows)), ""])


def _cells(row: Row) -> list[str]:
    def figures(pair: tuple[float, float] | None) -> list[str]:
        return [""] * 2 if pair is None else [f"{value:.1f}" for value in pair]

    if row.declined:
        return [row.recording, f"declined: {row.declined.split(':')[0]}", *[""] * 5]
    before, all_named = figures(row.first_db)
    noise = " -> ".join(figures(row.noise_db)) if row.noise_db else ""
    return [row.recording, ", ".join(row.named), ", ".join(row.kept), before, all_named, figures(row.erle_db)[1], noise]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=Path, nargs="+", default=[], metavar="DIR")
    parser.add_argument("--real", type=Path, nargs="+", default=[], metavar="DIR")
    parser.add_argument("--limit", type=int, metavar="N", help="at most N cases or pairs of each folder")
    parser.add_argument("--output", type=Path, metavar="PATH", help="also write PATH.md and PATH.json")
    options = parser.parse_args()
    if not options.cases and not options.real:
        parser.error("give --cases or --real")
    try:
        made_with = results_writer.stamp({"CASES": options.cases, "REAL": options.real})
        sources: list[tuple[Path, Iterable[Row]]] = [(f, of_cases(f, options.limit)) for f in options.cases]
        sources += [(f, of_real(f, options.limit)) for f in options.real]
        results = {folder.resolve().name: list(rows) for folder, rows in sources}
    except (EdgefilterError, OSError) as error:
        print(f"proven_names: {error}", file=sys.stderr)
        return 1
    summaries = {name: summarise(rows) for name, rows in results.items()}
    page = "\n".join(markdown(name, rows, summaries[name]) for name, rows in results.items())
    content = {"summary": summaries, "rows": {name: [asdict(row) for row in rows] for name, rows in results.items()}}
    print(results_writer.write(options.output, made_with, "What was named, proven on the rest", page, content))
    return 0


if __name__ == "__main__":
    sys.exit(main())
