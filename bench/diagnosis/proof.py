"""Proof without labels: what a diagnosis named, applied, and the running filter on unseen seconds.

--cases: folders as of the part `names`, each case with its calibration. --real: pairs NAME_lpb and NAME_mic (WAV or FLAC,
16 kHz) without one, those of a minute or more cut every PIECE_S; their profile is made from the recording, and compared
with the filter without any. The first three fifths of the robot's voice are diagnosed; what was named is fitted to them;
the filter, engine `linear`, starts anew on the rest, with and without it. What makes it worse is taken back, as
`diagnose --apply` does (kept). A change of the fan is proven by how far the expected noise is off that of the rest's
silences. Events (a jump, a moment's move) do not come again and are not proven here.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from bench import provenance, results
from bench.diagnosis.names import find_cases, signals
from bench.metrics import counted
from bench.provenance import DIAGNOSIS
from bench.recordings import CALIBRATION, find_recordings
from edgefilter.calibration.calibrate import calibrate
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.proof import WORSE_DB, lasts
from edgefilter.diagnosis.recording import Recording
from edgefilter.diagnosis.result import in_order
from edgefilter.dsp.frames import blocks, decibels, frames
from edgefilter.dsp.psd import floored, periodograms
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.model import EchoModel
from edgefilter.errors import EdgefilterError
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Samples

PIECE_S, WHOLE_S = 10, 45
"""Longer recordings than the latter are cut into pieces of the former."""
FEWEST_FRAMES, BAND = 6, 20
"""Half-overlapping frames of silence from which on the fan's spectrum can be told, in bands of so many bins of 13.3 Hz."""


@dataclass(frozen=True)
class Row:
    """One recording: what was named in its first part, what was kept, and what that did to the rest.

    named_db, kept_db: (before, after) ERLE of the running filter with all that was named and with what was kept; None
    where there was nothing lasting to prove. noise_db: (before, after) how far the expected noise is off, root mean
    square over frequency. declined: why nothing could be said.
    """

    recording: str
    named: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()
    named_db: tuple[float, float] | None = None
    kept_db: tuple[float, float] | None = None
    noise_db: tuple[float, float] | None = None
    declined: str = ""


def examine(name: str, profile: Profile | None, y: Samples, x: Samples) -> Row:
    """The row of recording y (n,) of the robot saying x (n,); profile None: one is made from the recording."""
    try:
        held = Recording(y, x, profile).held_out
        cut = held.cut
        first = Recording(y[:cut], x[:cut], profile)
        start, found = first.profile, first.diagnose()
        named = tuple(finding.effect for finding in in_order(found.ranking))
        noise = noise_off_db(start, found.model, y, x, cut) if any(find(e).stage == "noise" for e in named) else None
        kept = tuple(effect for effect in named if lasts(effect))
        if not kept and profile is not None:
            return Row(name, named, noise_db=noise)
        proofs = held.until_kept(kept)
    except EdgefilterError as error:
        return Row(name, declined=str(error))
    first, last = proofs[0], proofs[-1]
    after_db = last.erle_before_db if last.worse else last.erle_after_db
    pairs = (first.erle_before_db, first.erle_after_db), (last.erle_before_db, after_db)
    return Row(name, named, () if last.worse else last.effects, *pairs, noise)


def noise_off_db(profile: Profile, model: EchoModel, y: Samples, x: Samples, cut: int) -> tuple[float, float] | None:
    """How far the fan of the silences from cut on is off the profile's, and off the model's, dB; None where it never is silent."""
    prepared, size = prepare(profile, y, x), 2 * (profile.noise_psd.size - 1)
    silent = frames((prepared.usable & ~prepared.active)[cut:], size, size // 2).all(axis=1)
    if silent.sum() < FEWEST_FRAMES:
        return None
    found = _bands_db(np.mean(periodograms(y[cut:], size)[silent], axis=0))
    expected = profile.noise_psd, model.expected_noise(profile.noise_psd)
    before, after = (float(np.sqrt(np.mean((found - _bands_db(psd)) ** 2))) for psd in expected)
    return before, after


def _bands_db(psd: Samples) -> np.ndarray:
    """Level of a PSD (601,) in each band, dB, (bands,)."""
    return np.asarray(decibels(blocks(floored(psd), BAND).mean(axis=1)))


def of_cases(folder: Path, limit: int | None) -> Iterator[Row]:
    for case in find_cases(folder, limit):
        recorded = signals(case)
        profile = calibrate(*map(recorded.get, CALIBRATION))
        yield examine(case.name, profile, recorded["mic"], recorded["ref"])


def of_real(folder: Path, limit: int | None) -> Iterator[Row]:
    """A row for each pair of a folder, or each piece of it."""
    for pair in find_recordings(folder)[:limit]:
        recorded = pair.signals()
        n = recorded.mic.size
        step = PIECE_S * SAMPLE_RATE if n > WHOLE_S * SAMPLE_RATE else n
        for at in range(0, n - step + 1, step):
            name = pair.name + (f" from {at // SAMPLE_RATE} s" if step < n else "")
            yield examine(name, None, recorded.mic[at : at + step], recorded.ref[at : at + step])


def run(options: argparse.Namespace) -> str:
    made_with = provenance.stamp({"CASES": options.cases, "REAL": options.real}, [DIAGNOSIS, "linear-uncalibrated"])
    found = {folder.resolve().name: list(of_cases(folder, options.limit)) for folder in options.cases}
    found |= {folder.resolve().name: list(of_real(folder, options.limit)) for folder in options.real}
    rows = {name: [asdict(row) for row in of] for name, of in found.items()}
    title = "What was named, proven on the rest"
    return results.write(options.output, "proof", title, made_with, tables(found), rows=rows)


def tables(found: Mapping[str, Sequence[Row]]) -> list[dict]:
    """How often the error fell, stayed and rose with all that was named, and with what was kept; then each recording."""
    columns = ["", "recordings", "declined", "judged", "with", ("error fell, %", 0), ("by, dB (median)", 1), "rose",
               ("worst, dB", 1)]  # fmt: skip
    rows = [[name, *line] for name, of in found.items() for line in summary(of)]
    noise = {name: [row.noise_db for row in of if row.noise_db is not None] for name, of in found.items()}
    counts = {name: sum(after < before for before, after in of) for name, of in noise.items()}
    fans = ", ".join(f"{count} of {len(noise[name])} ({name})" for name, count in counts.items())
    made = [results.table("proof", "On unseen seconds", columns, rows, f"Changes of the fan that were proven: {fans}.")]
    head = ["recording", "named", "kept", ("ERLE before, dB", 1), ("named", 1), ("kept", 1), ("noise off, dB", 1),
            ("after", 1)]  # fmt: skip
    return made + [results.table(f"{name}-proof", name, head, map(_cells, of)) for name, of in found.items()]


def summary(rows: Sequence[Row]) -> list[list]:
    """Two lines of the table: for a profile with every effect that was named, and with those that `diagnose` kept."""
    tested = [row for row in rows if row.named_db is not None and row.kept_db is not None]
    lines = []
    for way in ("named", "kept"):
        change = [after - before for before, after in (getattr(row, f"{way}_db") for row in tested)]
        fell, rose = [db > WORSE_DB for db in change], sum(db < -WORSE_DB for db in change)
        figures = [float(np.median(change)), rose, min(change)] if change else [None, rose, None]
        declined = sum(bool(row.declined) for row in rows)
        lines.append([len(rows), declined, len(tested), f"all that was {way}" if way == "named" else "what was kept",
                      counted(fell) if change else None, *figures])  # fmt: skip
    return lines


def _cells(row: Row) -> list:
    if row.declined:
        return [row.recording, f"declined: {row.declined.split(':')[0]}", *[None] * 6]
    named, kept, noise = (pair or (None, None) for pair in (row.named_db, row.kept_db, row.noise_db))
    return [row.recording, ", ".join(row.named), ", ".join(row.kept), named[0], named[1], kept[1], *noise]
