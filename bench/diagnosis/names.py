"""Names: calibrate from each case's sweep, diagnose, count.

A case holds sweep_ref, sweep_mic, fan_only, ref, mic (FLAC) and truth.json (effects, raw, strength, and `also`: other
names that are right). Instead of truth.json files a folder may hold one seals.json: per case a salt and the sha256 of
salt + ":" + case + ":" + label. Then the diagnosis's own answer is hashed, and nothing else: a hit is the exact label
(effects sorted and joined by "+", none, unknown). Counts stand with 95 % Wilson intervals. Seconds are the processor's;
with --jobs above one they are not those of a free core.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from bench import provenance, results
from bench.metrics import counted
from bench.provenance import DIAGNOSIS
from bench.recordings import CALIBRATION, progress, read
from edgefilter.calibration.calibrate import calibrate
from edgefilter.diagnosis.recording import diagnose
from edgefilter.echo.effects.catalogue import find
from edgefilter.errors import UsageError
from edgefilter.types import Samples

SIGNALS = (*CALIBRATION, "ref", "mic")
STRENGTHS = ("clear", "moderate", "near")
EXPLAINED_LIMIT_DB = 1.0
"""Left error over the noise floor, dB, above which a case whose effect is not in the catalogue must never be called explained."""


@dataclass(frozen=True)
class Outcome:
    """One case: what it hid and what the diagnosis said.

    truth: effects, ("none",), ("unknown",), or empty where it is sealed. raw: what it is in detail. verdict: of the
    diagnosis, or "error". named: effects of its ranking, in order. before_db, after_db, share: excess before and after
    each of them, and the share that it explains. remaining_db: excess at the end. sealed_hit: whether the label's hash
    is that of the answer; None where nothing is sealed. also: other names that are right of what is hidden.
    """

    case: str
    truth: tuple[str, ...]
    raw: tuple[str, ...]
    strength: str
    verdict: str = "error"
    named: tuple[str, ...] = ()
    before_db: tuple[float, ...] = ()
    after_db: tuple[float, ...] = ()
    share: tuple[float, ...] = ()
    excess_db: float = np.nan
    remaining_db: float = np.nan
    evidence: str = ""
    seconds: float = 0.0
    sealed_hit: bool | None = None
    also: tuple[str, ...] = ()

    @property
    def group(self) -> str:
        if not self.truth:
            return "sealed"
        if self.truth in (("none",), ("unknown",)):
            return {"none": "controls", "unknown": "outside"}[self.truth[0]]
        return "singles" if len(self.truth) == 1 else "pairs"

    @property
    def label(self) -> str:
        """The answer as one label: the effects sorted and joined by "+", none, unknown, or error."""
        named = "+".join(sorted(self.named))
        return {"explained": "none", "unexplained": "unknown", "missing": named or "unknown"}.get(self.verdict, "error")

    @property
    def first(self) -> str:
        """The first effect named, else the verdict's label."""
        return self.named[0] if self.named else self.label

    @property
    def right(self) -> tuple[str, ...]:
        """Of a single effect: the names that are right."""
        return (self.truth[0], *self.also)

    @property
    def family_hit(self) -> bool:
        """Whether what is named first is of the family of a single effect, or of another name that is right; of several, all families are named."""
        if self.group == "pairs":
            return {find(name).family for name in self.truth} <= {find(name).family for name in self.named}
        return bool(self.named) and find(self.first).family in {find(name).family for name in self.right}

    @property
    def hit(self) -> bool:
        """Singles: named first. Several: all named. Controls: explained. Outside: unexplained. Sealed: the exact label."""
        if self.group == "sealed":
            return bool(self.sealed_hit)
        if self.group in ("controls", "outside"):
            return self.label == self.truth[0]
        return self.first in self.right if self.group == "singles" else set(self.truth) <= set(self.named)


def find_cases(folder: Path, limit: int | None) -> list[Path]:
    """The case folders, at most limit of them, evenly spread. Raises UsageError where there is none."""
    found = sorted(path.parent for path in folder.glob("*/mic.flac"))
    if not found:
        raise UsageError(f"{folder} holds no */mic.flac, expected cases: make some with bench.simulate.hidden_cases")
    if limit and limit < len(found):
        found = [found[i] for i in np.linspace(0, len(found) - 1, limit).astype(int)]
    return found


def signals(case: Path) -> dict[str, Samples]:
    return {name: read(case / f"{name}.flac") for name in SIGNALS}


def diagnosed(case: Path, truth: Mapping | None) -> Outcome:
    """Diagnose one case; an error of the product is its answer."""
    sealed = {"effects": [], "raw": [], "strength": "sealed"}
    known = sealed if truth is None else {"raw": truth["effects"], **truth}
    of = (case.name, tuple(sorted(known["effects"])), tuple(known["raw"]), known["strength"])
    recorded, started, said = signals(case), time.process_time(), {}
    try:
        profile = calibrate(*(recorded[name] for name in SIGNALS[:3]))
        found = diagnose(profile, recorded["mic"], recorded["ref"])
        each = {"named": "name", "before_db": "excess_before_db", "after_db": "excess_after_db", "share": "share"}
        said = {key: tuple(getattr(one, of) for one in found.ranking) for key, of in each.items()}
        said |= {"verdict": found.verdict, "evidence": found.evidence}
        said |= {"excess_db": found.comparison.excess_db, "remaining_db": found.remaining_db}
    except Exception as error:  # whatever it is, it is a miss of this case, and the other cases are scored
        said = {"evidence": f"{type(error).__name__}: {error}"}
    return Outcome(*of, **said, seconds=time.process_time() - started, also=tuple(known.get("also", ())))


def check_seal(outcome: Outcome, seal: Mapping) -> Outcome:
    """The outcome of a sealed case with sealed_hit set, from the hash of its own answer."""
    text = f"{seal['salt']}:{outcome.case}:{outcome.label}"
    return replace(outcome, sealed_hit=hashlib.sha256(text.encode()).hexdigest() == seal["sha256"])


def outcome(case: Path, seal: Mapping | None) -> Outcome:
    if seal is not None:
        return check_seal(diagnosed(case, None), seal)
    return diagnosed(case, json.loads((case / "truth.json").read_text(encoding="utf-8")))


def outcomes(folder: Path, limit: int | None, jobs: int) -> list[Outcome]:
    """Every case of a folder. Raises UsageError where a case has neither truth nor seal."""
    path = folder / "seals.json"
    seals = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    cases = find_cases(folder, limit)
    for case in cases:
        if not (case / "truth.json").exists() and case.name not in seals:
            raise UsageError(f"{case} has neither a truth.json nor an entry in {path}; expected one of them")
    sealed = [None if (case / "truth.json").exists() else seals[case.name] for case in cases]
    with ProcessPoolExecutor(jobs) as pool:
        found = pool.map(outcome, cases, sealed)
        return [next(found) for _ in progress(cases, "case", folder.name)]


def counts(found: Sequence[Outcome]) -> dict[str, dict]:
    """Hits, n and percent with its interval, by what is counted; what no case is there for is left out."""
    groups = ("singles", "controls", "pairs", "outside", "sealed")
    singles, controls, pairs, outside, sealed = ([one for one in found if one.group == group] for group in groups)
    flags: dict[str, Iterable[bool]] = {"one effect: named first": [one.hit for one in singles]}
    flags["one effect: family right"] = [one.family_hit for one in singles]
    for strength in STRENGTHS:
        of = [one for one in singles if one.strength == strength]
        flags[f"named first, {strength}"] = [one.hit for one in of]
        flags[f"among the first two, {strength}"] = [bool(set(one.right) & set(one.named[:2])) for one in of]
    flags["that effect and no other"] = [one.label in one.right for one in singles]
    flags["nothing: false alarms"] = [not one.hit for one in controls]
    flags["several effects: all named"] = [one.hit for one in pairs]
    flags["all of their families named"] = [one.family_hit for one in pairs]
    flags["at least one named"] = [bool(set(one.truth) & set(one.named)) for one in pairs]
    flags["all and no other"] = [set(one.truth) == set(one.named) for one in pairs]
    flags["outside the catalogue: unexplained"] = [one.hit for one in outside]
    wrong = [one.verdict == "explained" and one.excess_db > EXPLAINED_LIMIT_DB for one in outside]
    flags["explained above 1 dB of excess"] = wrong
    flags["sealed: the exact label"] = [one.hit for one in sealed]
    return {name: counted(of) for name, of in flags.items() if of}


def run(options: argparse.Namespace) -> str:
    """All folders, each with its columns in one table, then its effects and its misses."""
    made_with = provenance.stamp({"CASES": options.cases}, [DIAGNOSIS])
    found = {folder.resolve().name: outcomes(folder, options.limit, options.jobs) for folder in options.cases}
    cases = {name: [asdict(one) for one in of] for name, of in found.items()}
    title = "Hidden effects: what the diagnosis says"
    return results.write(options.output, "names", title, made_with, tables(found), cases=cases)


def tables(found: Mapping[str, Sequence[Outcome]]) -> list[dict]:
    by_folder = {name: counts(of) for name, of in found.items()}
    rows: list[list] = []
    for what in dict.fromkeys(what for of in by_folder.values() for what in of):
        each = [of.get(what) for of in by_folder.values()]
        rows.append([what, *(c and f"{c['hits']} of {c['n']}, {results.cell(c, 0)} %" for c in each)])
    times = [np.array([one.seconds for one in of]) for of in found.values()]
    rows.append(["seconds a case, median", *(float(np.median(of)) for of in times)])
    rows.append(["longest", *(float(of.max()) for of in times)])
    made = [results.table("names", "How often it is right", ["", *((name, 1) for name in found)], rows)]
    for name, of in found.items():
        if effects := by_effect(of):
            columns = ["effect", "named first", ("excess before, dB", 1), ("after", 1), ("after, worst", 1)]
            columns.append(("share removed, %", 0))
            text = "Excess: held-out, whitened, over the fan; medians of the cases where the effect was named first."
            made.append(results.table(f"{name}-effects", f"{name}: effects", columns, effects, text))
        if misses := [_miss(one) for one in of if not one.hit]:
            columns = ["case", "hidden", "strength", "said", ("excess, dB", 1), ("left, dB", 1), "evidence"]
            made.append(results.table(f"{name}-misses", f"{name}: {len(misses)} misses", columns, misses))
    return made


def by_effect(found: Sequence[Outcome]) -> list[list]:
    """A row for each single effect, and for each kind outside the catalogue."""
    rows = []
    for name in sorted({one.truth[0] for one in found if one.group == "singles"}):
        of = [one for one in found if one.group == "singles" and one.truth[0] == name]
        hits = [one for one in of if one.hit and one.named]
        row = [name, f"{sum(one.hit for one in of)} of {len(of)}", None, None, None, None]
        if hits:
            before, after, share = zip(*((one.before_db[0], one.after_db[0], one.share[0]) for one in hits))
            row[2:] = [float(np.median(before)), float(np.median(after)), max(after), 100 * float(np.median(share))]
        rows.append(row)
    for kind in sorted({one.raw[0] for one in found if one.group == "outside"}):
        of = [one for one in found if one.group == "outside" and one.raw[0] == kind]
        rows.append([f"{kind} (unexplained)", f"{sum(one.hit for one in of)} of {len(of)}", None, None, None, None])
    return rows


def _miss(one: Outcome) -> list:
    hidden = " or ".join(("+".join(one.truth), *one.also)) if one.truth else "sealed"
    detail = f" ({'+'.join(one.raw)})" if one.raw and set(one.raw) != set(one.truth) else ""
    said = one.verdict + (": " + ", ".join(one.named) if one.named else "")
    return [one.case, hidden + detail, one.strength, said, one.excess_db, one.remaining_db, one.evidence]
