"""From what a diagnosis said of each case to counts with intervals, a confusion matrix and a list of misses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bench import results_writer
from bench.measure.intervals import wilson

STRENGTHS = ("clear", "moderate", "near")
AT_A_GLANCE = {
    "one effect: named first": "top-1",
    "that one and no other": "singles: that effect and no other",
    "two: both named": "pairs: both named",
    "nothing: false alarms": "false alarms on controls",
    "outside the catalogue: unexplained": "outside: unexplained",
    "sealed: the exact label": "sealed: exact label",
}
EXPLAINED_LIMIT_DB = 1.0
"""Excess above which a case from outside the catalogue must never be called explained."""


@dataclass(frozen=True)
class Outcome:
    """One case: what it hid and what the diagnosis said.

    truth: effects, ("none",), ("unknown",), or empty where it is sealed. raw: what it is in detail. verdict: of the
    diagnosis, or "error". named: effects of its ranking, in order. before_db, after_db: excess before and after each of
    them. remaining_db: at the end. sealed_hit: whether the label's hash is that of the answer; None where nothing is
    sealed. also: other names that are right of what is hidden.
    """

    case: str
    truth: tuple[str, ...]
    raw: tuple[str, ...]
    strength: str
    verdict: str
    named: tuple[str, ...]
    before_db: tuple[float, ...]
    after_db: tuple[float, ...]
    share: tuple[float, ...]
    excess_db: float
    remaining_db: float
    evidence: str
    seconds: float
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
    def hit(self) -> bool:
        """Singles: named first. Pairs: both named.

        Controls: nothing named, explained. Outside: unexplained. Sealed: the exact label.
        """
        if self.group == "sealed":
            return bool(self.sealed_hit)
        if self.group in ("controls", "outside"):
            return self.label == self.truth[0]
        right = (self.truth[0], *self.also)
        return self.first in right if self.group == "singles" else set(self.truth) <= set(self.named)


def counted(flags: Iterable[bool]) -> dict:
    """hits, n, percent and its interval."""
    flags = list(flags)
    low, high = wilson(sum(flags), len(flags))
    return {
        "hits": sum(flags),
        "n": len(flags),
        "percent": 100 * sum(flags) / max(len(flags), 1),
        "low": 100 * low,
        "high": 100 * high,
    }


def summarise(outcomes: Sequence[Outcome]) -> dict:
    """All figures of one folder of cases; groups without a case are left out."""
    groups = {
        name: [o for o in outcomes if o.group == name] for name in ("singles", "controls", "pairs", "outside", "sealed")
    }
    singles, controls, pairs, outside = (groups[name] for name in ("singles", "controls", "pairs", "outside"))
    counts = {"top-1": counted(o.hit for o in singles)}
    for strength in STRENGTHS:
        of = [o for o in singles if o.strength == strength]
        counts[f"top-1, {strength}"] = counted(o.hit for o in of)
        counts[f"top-2, {strength}"] = counted(bool({o.truth[0], *o.also} & set(o.named[:2])) for o in of)
    counts["singles: that effect and no other"] = counted(o.label in (o.truth[0], *o.also) for o in singles)
    counts["false alarms on controls"] = counted(not o.hit for o in controls)
    counts["pairs: both named"] = counted(o.hit for o in pairs)
    counts["pairs: at least one named"] = counted(bool(set(o.truth) & set(o.named)) for o in pairs)
    counts["pairs: both and no other"] = counted(set(o.truth) == set(o.named) for o in pairs)
    counts["outside: unexplained"] = counted(o.hit for o in outside)
    counts["outside: explained above 1 dB of excess"] = counted(
        o.verdict == "explained" and o.excess_db > EXPLAINED_LIMIT_DB for o in outside
    )
    counts["sealed: exact label"] = counted(bool(o.sealed_hit) for o in groups["sealed"])
    counts = {name: count for name, count in counts.items() if count["n"]}
    seconds = [o.seconds for o in outcomes]
    times = {
        "p50": float(np.median(seconds)),
        "max": float(max(seconds)),
        "slowest": max(outcomes, key=lambda o: o.seconds).case,
    }
    by_effect = {}
    for name in sorted({o.truth[0] for o in singles}):
        of = [o for o in singles if o.truth[0] == name]
        by_effect[name] = {"top-1": counted(o.hit for o in of)} | _errors([o for o in of if o.hit])
    kinds = {kind: counted(o.hit for o in outside if o.raw[0] == kind) for kind in sorted({o.raw[0] for o in outside})}
    return {
        "counts": counts,
        "by_effect": by_effect,
        "outside": kinds,
        "confusion": confusion(outcomes),
        "seconds": times,
    }


def _errors(found: Sequence[Outcome]) -> dict:
    """Medians, and the worst, of the held-out excess before and after the effect named first, and of its share."""
    if not found:
        return {}
    after = [o.after_db[0] for o in found]
    before, share = float(np.median([o.before_db[0] for o in found])), float(np.median([o.share[0] for o in found]))
    return {
        "before_db": before,
        "after_db": float(np.median(after)),
        "after_max_db": max(after),
        "share_percent": 100 * share,
    }


def confusion(outcomes: Sequence[Outcome]) -> dict[str, dict[str, int]]:
    """[hidden][named first] -> cases, of singles, controls and what is outside the catalogue."""
    matrix: dict[str, dict[str, int]] = {}
    for o in outcomes:
        if o.group in ("singles", "controls", "outside"):
            row = matrix.setdefault(o.truth[0], {})
            row[o.first] = row.get(o.first, 0) + 1
    return {name: matrix[name] for name in sorted(matrix)}


def glance(summaries: Mapping[str, dict]) -> str:
    """All folders in one table, for two and more: the figures that matter most, each with its interval."""
    if len(summaries) < 2:
        return ""
    rows = {
        what: [_counted_cell(s["counts"].get(key)) for s in summaries.values()] for what, key in AT_A_GLANCE.items()
    }
    for what, key in (("seconds per case, median", "p50"), ("longest", "max")):
        rows[what] = [f"{s['seconds'][key]:.1f}" for s in summaries.values()]
    told = [[what, *cells] for what, cells in rows.items() if any(cells)]
    return "\n".join([*results_writer.table(["", *summaries], told), "", ""])


def _counted_cell(count: dict | None) -> str:
    return f"{count['hits']} of {count['n']} [{count['low']:.0f}, {count['high']:.0f}] %" if count else ""


def markdown(name: str, outcomes: Sequence[Outcome], summary: dict) -> str:
    """One folder of cases as a section in Markdown."""
    lines = [f"## {name}: {len(outcomes)} cases", "", "| | cases | % | 95 % interval |", "| --- | --- | --- | --- |"]
    lines += [
        f"| {key} | {c['hits']} of {c['n']} | {c['percent']:.0f} | {c['low']:.0f} to {c['high']:.0f} |"
        for key, c in summary["counts"].items()
    ]
    times = summary["seconds"]
    lines += ["", f"Seconds per case: median {times['p50']:.1f}, longest {times['max']:.1f} ({times['slowest']})."]
    if summary["by_effect"]:
        lines += [
            "",
            "| effect | named first | excess before, dB | after | after, worst | share removed, % |",
            "| --- " * 6 + "|",
        ]
        lines += [_effect_line(effect, row) for effect, row in summary["by_effect"].items()]
        lines += [
            "",
            "Excess: held-out, whitened, over the fan; medians of the cases where the effect was named first.",
        ]
    if summary["outside"]:
        lines += ["", "Outside the catalogue, called unexplained: "]
        lines[-1] += (
            ", ".join(f"{kind} {count['hits']} of {count['n']}" for kind, count in summary["outside"].items()) + "."
        )
    lines += _confusion_lines(summary["confusion"]) + _miss_lines([o for o in outcomes if not o.hit])
    return "\n".join(lines) + "\n"


def _effect_line(effect: str, row: dict) -> str:
    count = f"{row['top-1']['hits']} of {row['top-1']['n']}"
    figures = [""] * 4
    if "before_db" in row:
        figures = [
            *(f"{row[key]:.1f}" for key in ("before_db", "after_db", "after_max_db")),
            f"{row['share_percent']:.0f}",
        ]
    return "| " + " | ".join([effect, count, *figures]) + " |"


def _confusion_lines(matrix: dict[str, dict[str, int]]) -> list[str]:
    if not matrix:
        return []
    columns = sorted(set(matrix) | {name for row in matrix.values() for name in row})
    lines = [
        "",
        "Hidden (rows), named first (columns):",
        "",
        "| | " + " | ".join(columns) + " |",
        "| --- " * (len(columns) + 1) + "|",
    ]
    return lines + [
        f"| {name} | " + " | ".join(str(row.get(column, "")) for column in columns) + " |"
        for name, row in matrix.items()
    ]


def _miss_lines(misses: Sequence[Outcome]) -> list[str]:
    if not misses:
        return ["", "No misses."]
    lines = [
        "",
        f"Misses ({len(misses)}):",
        "",
        "| case | hidden | strength | said | excess, dB | left, dB | evidence |",
        "| --- " * 7 + "|",
    ]
    for o in misses:
        hidden = (
            "sealed"
            if not o.truth
            else " or ".join(("+".join(o.truth), *o.also))
            + ("" if set(o.raw) == set(o.truth) or not o.raw else f" ({'+'.join(o.raw)})")
        )
        said = o.verdict + (": " + ", ".join(o.named) if o.named else "")
        lines.append(
            f"| {o.case} | {hidden} | {o.strength} | {said} | {o.excess_db:.1f} | {o.remaining_db:.1f} "
            f"| {o.evidence.replace('|', '/')} |"
        )
    return lines
