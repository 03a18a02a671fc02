"""A comparison or a diagnosis as one HTML file that holds its pictures, its sound and its program, and needs no network."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from itertools import product
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from edgefilter.audio.files import whole
from edgefilter.diagnosis.compare import Comparison, describe
from edgefilter.diagnosis.laws import Law
from edgefilter.diagnosis.passport import ENOUGH_DB, Passport
from edgefilter.diagnosis.proof import Proof
from edgefilter.diagnosis.recording import Recording
from edgefilter.diagnosis.result import Diagnosis, Finding, Precision, in_order
from edgefilter.diagnosis.straightened import Straightened
from edgefilter.diagnosis.trials import less
from edgefilter.echo.model import EchoModel
from edgefilter.report import passport, text
from edgefilter.report.media import MAX_SOUND_S, colour_scale, colours, sound, spectrogram_png
from edgefilter.types import SAMPLE_RATE, Samples

LOUDER = 10.0
"""How much louder than the recording the residual is stored; the page turns it down to its true level, or not (20
dB)."""
MAX_FREE = 3
"""Up to so many effects every subset is computed; of more only those that leave out the last ones."""
TERMS = {
    "budget": {
        "Noise floor": "the fan alone; dBFS are decibels of full scale.",
        "Irreducible": "noise that the robot makes or its stream adds. Its level follows the voice; its waveform nothing predicts.",
    },
    "spectra": {
        "Prediction": "what the profile, and each effect that is switched on, make of the reference, the sound that was played.",
        "ERLE": "by how many decibels the running filter lowers the robot while it talks alone.",
    },
    "where": {
        "Excess": "power of recording minus prediction over the fan's, both through a filter that makes the fan white. Lag and"
        " what the fan does by itself are no error.",
        "Lag": "how much later than the reference a sound comes: the first arrival at once, a room for a second.",
    },
    "found": {"By chance": "how often a recording in which nothing is missing shows as much of the effect."},
    "statistics": {
        "White": "of the same power at all frequencies, as the fan is behind its filter: one sample tells nothing of the next."
    },
    "known": {"Standard error": "the true value is nearer than this in two of three recordings."},
    "tried": {
        "Held out": "every second half second: no fit has used it, so that an effect that is not there gains nothing."
    },
}
"""The page's glossary: for each section of the page, the terms that stand beside it and what they mean."""

Choice = tuple[bool, ...]


def comparison_page(found: Comparison, names: Mapping[str, Any]) -> str:
    """The page of a comparison.

    names: profile (None: the recording itself was taken for it), recording, reference, what the files are called.
    """
    profile = "The profile" if names["profile"] else "A stationary linear path made from the recording itself"
    excess = f"{profile} leaves {text.decibels(found.excess_db)} dB over the noise floor unexplained."
    none: dict[str, object] = {"findings": [], "command": [], "left": "", "law": None}
    return _page({(): found}, (), {"kind": "comparison", "headline": excess, **none, **_statistics()}, names)


def diagnosis_page(
    recording: Recording,
    found: Diagnosis,
    names: Mapping[str, Any],
    outcome: Sequence[tuple[str, str, str]] = (),
    proof: Proof | None = None,
) -> str:
    """The page of a diagnosis, with a switch for each found effect.

    recording: what was diagnosed. outcome: further figures at the top, where a profile was written. proof: what the running
    filter makes of it, to listen to.
    """
    steps = in_order(found.ranking)
    variants = compare_variants(recording.straightened, found.model, steps)
    if found.written:
        variants[(True,) * len(steps)] = found.written
    fields = {
        "kind": "diagnosis",
        "headline": text.headline(found.verdict, [finding.name for finding in found.ranking], bool(names["profile"])),
        "findings": [_finding(finding) for finding in found.ranking],
        "command": text.next_command(found, names, names.get("apply") if outcome else None).split(" "),
        "left": text.sentence(found.evidence) if found.evidence else "",
        "law": _law(found.law),
        **_statistics(found),
    }
    return _page(variants, steps, fields, names, found.irreducible_db, outcome, proof)


def passport_page(found: Passport, diagnosis: str, names: Mapping[str, Any]) -> str:
    """The page of a device's passport, of which no part needs a script.

    diagnosis: what it names, in a sentence. names: recording, reference, what the files are called.
    """
    series = ["linear, by coherence", *found.engines]
    heights = [[band.removable_db, *band.removed_db.values()] for band in found.bands]
    top = 10.0 * math.ceil(max([20.0, *(db for group in heights for db in group)]) / 10.0)
    wide = 676 / len(found.bands)
    bars = [
        (kind, round(40 + wide * (at + 0.1 + 0.8 * kind / len(series)), 1), round(200 - 190 * db / top, 1),
         round(0.8 * wide / len(series) - 1, 1), round(190 * db / top, 1))
        for at, group in enumerate(heights) for kind, db in enumerate(max(one, 0.0) for one in group)
    ]  # fmt: skip
    labels = [f"{band.low:.0f}-{band.high:.0f} Hz" for band in found.bands]
    figures = [
        [f"{band.mic_db:.0f}", f"{band.over_noise_db:.1f}", f"{band.follows:.2f}", f"{band.removable_db:.1f}",
         *(f"{db:.1f}" for db in band.removed_db.values())]
        for band in found.bands
    ]  # fmt: skip
    told = passport.expectation(found)
    fields = {
        **{role: Path(str(names[role])).name for role in ("recording", "reference")},
        "seconds": f"{found.seconds:.1f}",
        **{key: told[key] for key in ("headline", "cause", "changes")},
        "engines": passport.engine_lines(found),
        "uncertainty": passport.uncertainty(found),
        "facts": passport.rows(found),
        "enough": f"{ENOUGH_DB:.0f} dB are enough for a human 10 dB below the robot.",
        "series": series,
        "grid": [(200 - 190 * db / top, f"{db:.0f} dB") for db in (0.0, top / 2, top)],
        "bars": bars,
        "ticks": [(round(40 + wide * (at + 0.5), 1), label) for at, label in enumerate(labels)],
        "heads": ["band", "level, dBFS", "over noise, dB", "follows", *(f"{name}, dB" for name in series)],
        "bands": [[label, *row] for label, row in zip(labels, figures, strict=True)],
        "diagnosis": diagnosis,
    }
    return _rendered("passport.html", fields)


def write_page(path: str | Path, page: str) -> None:
    """Write the page; raises AudioFileError where it cannot be written."""
    with whole(path, "the report") as file:
        file.write(page.encode(errors="backslashreplace"))


def _page(
    variants: Mapping[Choice, Comparison],
    steps: Sequence[Finding],
    fields: Mapping[str, object],
    names: Mapping[str, Any],
    irreducible_db: float | None = None,
    outcome: Sequence[tuple[str, str, str]] = (),
    proof: Proof | None = None,
) -> str:
    before, after = variants[(False,) * len(steps)], variants[(True,) * len(steps)]
    scale, roles = colour_scale(before.recording), ("profile", "recording", "reference")
    fields = {
        **fields,
        **{role: Path(str(names[role] or "none: the recording itself")).name for role in roles},
        "facts": [*_facts(before, after if steps else None, irreducible_db), *outcome],
        "proven": text.proof_line(proof, "").removeprefix("proof").strip() if proof else "",
        "terms": TERMS,
        "switches": [text.title(finding.effect) for finding in steps],
        "notes": _notes(before),
        "seconds": f"{before.recording.size / SAMPLE_RATE:.1f}",
        "floor": f"{before.noise_floor_db:.1f}",
        "gradient": ", ".join("rgb({},{},{})".format(*colour) for colour in colours()[::7].tolist()),
        "bottom": f"{scale[0]:.0f}",
        "top": f"{scale[1]:.0f}",
        "free": "" if len(steps) <= MAX_FREE else "Later effects build on earlier ones and are switched with them.",
        "data": _data(variants, before, irreducible_db or 0.0, scale, proof),
    }
    return _rendered("page.html", fields)


def _rendered(name: str, fields: Mapping[str, object]) -> str:
    """A page with its fields, which are escaped and have to be there, and the date."""
    page = jinja2.Environment(
        loader=jinja2.FunctionLoader(_asset),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        keep_trailing_newline=True,
    )
    page.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return page.get_template(name).render(fields, date=datetime.date.today().isoformat())


def _data(
    variants: Mapping[Choice, Comparison],
    before: Comparison,
    irreducible_db: float,
    scale: tuple[float, float],
    proof: Proof | None,
) -> dict:
    """What the program draws; pictures and sounds that occur twice are held once."""
    gain = 10 ** (-1 / 20) / max(float(abs(before.recording).max()), 1e-6)
    media: dict[str, str] = {}

    def kept(samples: Samples, gain: float) -> dict[str, str]:
        contents = {"picture": spectrogram_png(samples, scale), "sound": sound(samples, gain)}
        return {kind: media.setdefault(content, f"m{len(media)}") for kind, content in contents.items()}

    return {
        "seconds": before.recording.size / SAMPLE_RATE,
        "floor_db": before.noise_floor_db,
        "irreducible_db": irreducible_db,
        "louder": LOUDER,
        "human": before.human,
        "recording": kept(before.recording, gain),
        "filtered": proof
        and {
            "from_s": proof.start_s,
            "before": kept(proof.left_before, gain),
            "after": kept(proof.left_after, gain),
        },
        "variants": {
            "".join("01"[on] for on in choice): {
                "excess_db": round(found.excess_db, 3),
                "silence_db": round(found.silence_excess_db, 3) if math.isfinite(found.silence_excess_db) else None,
                "bands": _rounded(found.bands),
                "times": _rounded(found.times),
                "levels": _rounded(found.levels),
                "lags": _rounded(
                    (low, high, share * _error(found) / max(_error(before), 1e-6)) for low, high, share in found.lags
                ),
                "correlations": text.correlograms(found.independence),
                "prediction": kept(found.prediction, gain),
                "residual": kept(found.residual, gain * LOUDER),
            }
            for choice, found in variants.items()
        },
        "media": {name: content for content, name in media.items()},
    }


def _error(found: Comparison) -> float:
    """Power of what is unexplained, in units of the fan's."""
    return max(10 ** (found.excess_db / 10) - 1, 0.0)


def _rounded(rows: Iterable[tuple[float, float, float]]) -> list[list[float]]:
    return [[round(float(x), 3) for x in row] for row in rows]


def _statistics(found: Diagnosis | None = None) -> dict[str, object]:
    """The tables of what was tried and of what is known; a comparison has none."""
    tried, known = (found.tried, found.precision) if found else ((), Precision())
    return {
        "tried": {
            "heads": text.HEADS,
            "rows": [{"cells": text.cells_of(one), "named": one.verdict == "named"} for one in tried],
        },
        "known": {
            "numbers": [(one.label, text.error_text(one)) for one in known.numbers],
            "correlations": [(first, second, f"{r:+.2f}".replace("-", "−")) for first, second, r in known.correlations],
        },
        "advice": [text.sentence(line) for line in found.advice] if found else [],
    }


def _facts(before: Comparison, after: Comparison | None, irreducible_db: float | None) -> list[tuple[str, str, str]]:
    """The figures at the top: term, value, explanation."""
    facts = [
        ("Unexplained", f"{text.decibels(before.excess_db)} dB", "over the noise floor, with the profile as it is")
    ]
    if before.drift_ppm:
        facts.append(
            ("Clocks", text.apart(before.drift_ppm), "runs the microphone's than the reference's; compensated")
        )
    if irreducible_db:
        facts.append(("Left", f"{text.decibels(irreducible_db)} dB", f"over the fan: {text.IRREDUCIBLE}"))
    elif after is not None:
        facts.append(("With what was found", f"{text.decibels(after.excess_db)} dB", "over the noise floor"))
    return [*facts, ("Noise floor", f"{before.noise_floor_db:.1f} dBFS", "the fan, from the calibration")]


def _law(law: Law | None) -> dict[str, str] | None:
    """The law in words, its curve as points of a drawing 100 wide and 40 high; zero: the height of 0 dB."""
    if law is None:
        return None
    curve = law.curve
    low, high = min(0.0, *curve.y_db), max(0.0, *curve.y_db)
    x = np.log(curve.x) if curve.x_unit == "Hz" else np.array(curve.x)
    across, up = max(float(x[-1] - x[0]), 1e-9), max(high - low, 1.0)
    points = zip(100 * (x - x[0]) / across, 40 * (high - np.array(curve.y_db)) / up, strict=True)
    return {
        "words": text.sentence(law.words),
        "family": law.family,
        "name": f"{law.family}: the law by {curve.name}",
        "points": " ".join(f"{a:.2f},{b:.2f}" for a, b in points),
        "zero": f"{40 * high / up:.2f}",
        "from": f"{curve.x[0]:.3g}",
        "to": f"{curve.x[-1]:.4g} {curve.x_unit}",
        "range": f"{low:+.1f} to {high:+.1f} {curve.y_unit}".replace("-", "−"),
    }


def _finding(finding: Finding) -> dict[str, object]:
    """What the page says of one effect."""
    return {
        "title": text.heading(finding),
        "effect": finding.effect,
        "before": text.decibels(finding.excess_before_db),
        "after": text.decibels(finding.excess_after_db),
        "share": f"{100 * finding.share:.0f}",
        "evidence": text.sentence(finding.evidence),
        "family": text.sentence(f"{finding.family}; {text.chance(finding)}"),
        "parameters": list(text.known_parameters(finding).items()),
    }


def _notes(found: Comparison) -> list[str]:
    """Warnings and what else a reader must know about the recording."""
    notes = list(found.warnings)
    seconds = found.recording.size / SAMPLE_RATE
    if seconds > MAX_SOUND_S:
        notes.append(
            f"The players hold the first {MAX_SOUND_S} s of {seconds:.0f} s; pictures and figures cover all of it."
        )
    return notes


def _asset(name: str) -> str:
    return resources.files("edgefilter.report").joinpath(name).read_text(encoding="utf-8")


def choices(count: int) -> list[Choice]:
    """Which of count effects are on, for each comparison that a report holds.

    The one with none comes first, with all last.
    """
    if count <= MAX_FREE:
        return list(product((False, True), repeat=count))
    return [tuple(i < on for i in range(count)) for on in range(count + 1)]


def compare_variants(prepared: Straightened, model: EchoModel, findings: Sequence[Finding]) -> dict[Choice, Comparison]:
    """For each choice of findings, a recording against model, which has them all, without those that are off.

    The excess of each is the diagnosis's; where it is, is shown for all samples.
    """
    found = {}
    for choice in choices(len(findings)):
        partial = model
        for finding, on in zip(findings, choice, strict=True):
            partial = partial if on else less(prepared.model, partial, finding.effect)
        found[choice] = describe(prepared, partial)
    return found
