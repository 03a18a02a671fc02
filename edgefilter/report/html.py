"""A comparison or a diagnosis as one HTML file that holds its pictures, its sound and its program, and needs no network."""

from __future__ import annotations

import datetime
import html
import json
import math
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path

from edgefilter.diagnosis.compare import Comparison
from edgefilter.diagnosis.diagnose import Diagnosis, Finding
from edgefilter.errors import EdgefilterError
from edgefilter.profile.data import Profile
from edgefilter.report.media import MAX_SOUND_S, colour_scale, colours, sound, spectrogram_png
from edgefilter.report.text import in_order
from edgefilter.report.variants import MAX_FREE, Choice, compare_variants
from edgefilter.report.words import decibels, headline, interval_text, sentence, title
from edgefilter.types import SAMPLE_RATE, Samples

LOUDER = 10.0
"""How much louder than the recording the residual is stored; the page turns it down to its true level, or not (20 dB)."""


def comparison_page(found: Comparison, names: Mapping[str, object]) -> str:
    """The page of a comparison. names: profile (None: the recording itself was taken for it), recording, reference, what the files are called."""
    profile = "The profile" if names["profile"] else "A stationary linear path made from the recording itself"
    excess = f"{profile} leaves {decibels(found.excess_db)} dB over the noise floor unexplained."
    text = {"kind": "comparison", "headline": excess, "findings": "", "left": "", "irreducible": ""}
    return _page({(): found}, (), text, names)


def diagnosis_page(profile: Profile, found: Diagnosis, recording: Samples, reference: Samples, names: Mapping[str, object]) -> str:
    """The page of a diagnosis, with a switch for each found effect. recording (n,), reference (m,): what was diagnosed."""
    steps = in_order(found.ranking)
    variants = compare_variants(profile, found.model, steps, recording, reference)
    text = {
        "kind": "diagnosis",
        "headline": headline(found.verdict, [finding.effect for finding in found.ranking], bool(names["profile"])),
        "findings": "".join(_finding(rank, finding, names) for rank, finding in enumerate(found.ranking, start=1)),
        "left": _section("What is left", f"<p>{html.escape(sentence(found.evidence))}</p>") if found.evidence else "",
        "irreducible": f"{decibels(found.irreducible_db)} dB",
    }
    return _page(variants, steps, text, names, found.irreducible_db)


def add_command(effect: str, names: Mapping[str, object]) -> str:
    """What to type to have that effect in a new profile; without a profile, to have one at all."""
    if names["profile"] is None:
        return "edgefilter calibrate --live --output robot.npz"
    files = " ".join(f"--{role} {shlex.quote(str(names[role]))}" for role in ("profile", "recording", "reference"))
    own = "".join(f" --effects {shlex.quote(str(file))}" for file in names.get("effects") or ())
    output = Path(str(names["profile"])).with_suffix(f".{effect}.npz")
    return f"edgefilter add {effect} {files}{own} --output {shlex.quote(str(output))}"


def write_page(path: str | Path, page: str) -> None:
    """Write the page; raises EdgefilterError where it cannot be written."""
    try:
        Path(path).write_text(page, encoding="utf-8")
    except OSError as error:
        raise EdgefilterError(f"{path}: the report cannot be written ({error.strerror}); name a .html file in a folder that exists") from None


def _page(
    variants: Mapping[Choice, Comparison],
    findings: Sequence[Finding],
    text: Mapping[str, str],
    names: Mapping[str, object],
    irreducible_db: float = 0.0,
) -> str:
    before, after = variants[(False,) * len(findings)], variants[(True,) * len(findings)]
    seconds = before.recording.size / SAMPLE_RATE
    scale = colour_scale(before.recording)
    data = _data(variants, before, irreducible_db, scale)
    fields = {key: html.escape(value) if key in ("kind", "headline", "irreducible") else value for key, value in text.items()}
    fields |= {role: html.escape(Path(str(names[role] or "none: the recording itself")).name) for role in ("profile", "recording", "reference")}
    fields |= {
        "facts": _facts(before, after, bool(findings), text["irreducible"]),
        "switches": "".join(_switch(i, finding) for i, finding in enumerate(findings)),
        "notes": _notes(before, seconds),
        "seconds": f"{seconds:.1f}",
        "floor": f"{before.noise_floor_db:.1f}",
        "date": datetime.date.today().isoformat(),
        "gradient": ", ".join("rgb({},{},{})".format(*colour) for colour in colours()[::7].tolist()),
        "bottom": f"{scale[0]:.0f}",
        "top": f"{scale[1]:.0f}",
        "free": "" if len(findings) <= MAX_FREE else "Later effects build on earlier ones and are switched with them.",
        "style": _asset("page.css"),
        "program": _asset("page.js"),
        "data": json.dumps(data, allow_nan=False, separators=(",", ":")).replace("</", "<\\/"),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda field: fields[field[1]], _asset("page.html"))


def _data(variants: Mapping[Choice, Comparison], before: Comparison, irreducible_db: float, scale: tuple[float, float]) -> dict:
    """What the program draws; pictures and sounds that occur twice are held once."""
    gain = 10 ** (-1 / 20) / max(float(abs(before.recording).max()), 1e-6)
    media: dict[str, str] = {}

    def keep(content: str) -> str:
        name = f"m{list(media.values()).index(content)}" if content in media.values() else f"m{len(media)}"
        media[name] = content
        return name

    return {
        "seconds": before.recording.size / SAMPLE_RATE,
        "floor_db": before.noise_floor_db,
        "irreducible_db": irreducible_db,
        "louder": LOUDER,
        "human": before.human,
        "recording": {"picture": keep(spectrogram_png(before.recording, scale)), "sound": keep(sound(before.recording, gain))},
        "variants": {
            "".join("01"[on] for on in choice): {
                "excess_db": round(found.excess_db, 3),
                "silence_db": round(found.silence_excess_db, 3) if math.isfinite(found.silence_excess_db) else None,
                "bands": _rounded(found.bands),
                "times": _rounded(found.times),
                "levels": _rounded(found.levels),
                "lags": _rounded((low, high, share * _error(found) / max(_error(before), 1e-6)) for low, high, share in found.lags),
                "prediction": {"picture": keep(spectrogram_png(found.prediction, scale)), "sound": keep(sound(found.prediction, gain))},
                "residual": {"picture": keep(spectrogram_png(found.residual, scale)), "sound": keep(sound(found.residual, gain * LOUDER))},
            }
            for choice, found in variants.items()
        },
        "media": media,
    }


def _error(found: Comparison) -> float:
    """Power of what is unexplained, in units of the fan's."""
    return max(10 ** (found.excess_db / 10) - 1, 0.0)


def _rounded(rows: Iterable[tuple[float, float, float]]) -> list[list[float]]:
    return [[round(float(x), 3) for x in row] for row in rows]


def _facts(before: Comparison, after: Comparison, found: bool, irreducible: str) -> str:
    """The figures at the top, as terms and values."""
    facts = [("Unexplained", f"{decibels(before.excess_db)} dB", "over the noise floor, with the profile as it is")]
    if found:
        facts.append(("With what was found", f"{decibels(after.excess_db)} dB", "over the noise floor"))
    facts.append(("Noise floor", f"{before.noise_floor_db:.1f} dBFS", "the fan, from the calibration"))
    if irreducible:
        facts.append(("Irreducible", irreducible, "that no model can predict"))
    return "".join(f"<div><dt>{a}</dt><dd><b>{html.escape(b)}</b> {html.escape(c)}</dd></div>" for a, b, c in facts)


def _switch(index: int, finding: Finding) -> str:
    return f'<label><input type="checkbox" checked data-effect="{index}"> {html.escape(title(finding.effect))}</label>'


def _finding(rank: int, finding: Finding, names: Mapping[str, object]) -> str:
    rows = "".join(f"<tr><th>{html.escape(name)}</th><td>{html.escape(interval_text(x))}</td></tr>" for name, x in finding.parameters.items())
    return (
        f"<li><h3>{html.escape(title(finding.effect))} <code>{html.escape(finding.effect)}</code></h3>"
        f'<p class="fall">{decibels(finding.excess_before_db)} dB &rarr; {decibels(finding.excess_after_db)} dB '
        f"<small>{100 * finding.share:.0f} % of what was unexplained</small></p>"
        f"<p>{html.escape(sentence(finding.evidence))}</p><table>{rows}</table>"
        f'<p class="command"><code>{_unbroken(add_command(finding.effect, names))}</code></p></li>'
    )


def _unbroken(command: str) -> str:
    """The command so that lines break between its words and not at the hyphens in them."""
    return " ".join(f"<span>{html.escape(word)}</span>" for word in command.split(" "))


def _notes(found: Comparison, seconds: float) -> str:
    """Warnings and what else a reader must know about the recording."""
    notes = list(found.warnings)
    if found.human:
        spans = ", ".join(f"{start:.1f} to {end:.1f} s" for start, end in found.human)
        notes.append(f"Somebody talks at {spans}; those stretches are left out of every figure.")
    if seconds > MAX_SOUND_S:
        notes.append(f"The players hold the first {MAX_SOUND_S} s of {seconds:.0f} s; pictures and figures cover all of it.")
    return _section("Notes", "<ul>" + "".join(f"<li>{html.escape(note)}</li>" for note in notes) + "</ul>") if notes else ""


def _section(heading: str, content: str) -> str:
    return f"<section><h2>{heading}</h2>{content}</section>"


def _asset(name: str) -> str:
    return resources.files("edgefilter.report").joinpath(name).read_text(encoding="utf-8")
