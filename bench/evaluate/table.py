"""The tables as Markdown and as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from bench.evaluate.figures import Group, Results
from bench.evaluate.systems import System
from bench.results_writer import table

NOTES = (
    "Mean [95 % interval], drawn over speakers and rooms, not over utterances; median; standard deviation. WER: word",
    "errors over the span in which the human speaks; 'capped' counts an utterance as at most 100 %, 'pooled' is over all",
    "words, 'ins' and 'del' are words put in and left out over all words. 'Less the best other' is the difference in",
    "capped WER (in SI-SDR without a recogniser) from the best other row that a robot can have, on the same clips: below",
    "0 is better in words. ERLE: the last seconds of robot alone before the human. AECMOS: 1 to 5, for echo and for the",
    "human. Compute: seconds for 5 s of sound on one core. Latency: of the windows alone; 'end' answers at the end.",
)
WORDS = ("WER %", "median", "std", "pooled", "capped", "ins", "del")
PLAIN = ("SI-SDR dB", "median", "std", "ESTOI", "ERLE dB", "echo MOS", "human MOS", "compute s", "latency ms")


def interval(found: Mapping | None, digits: int, key: str = "mean") -> str:
    """A mean with its interval; empty without."""
    if not found:
        return ""
    if found["low"] is None:
        return f"{found[key]:.{digits}f}"
    return f"{found[key]:.{digits}f} [{found['low']:.{digits}f}, {found['high']:.{digits}f}]"


def latency(system: System) -> str:
    """In ms; nothing for a bound."""
    late = "" if system.kind == "bound" else "end"
    return late if system.latency_ms is None else f"{system.latency_ms:.0f}"


def number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def content(results: Results) -> list[dict]:
    """What the JSON file holds of every group."""
    return [
        {
            "set": group.set,
            "room": group.room,
            "clips": len(group.members),
            "speakers": len({results.clips[index].speaker for index in group.members}),
            "rows": {system.name: group.figures(system) for system in results.systems},
        }
        for group in results.groups
    ]


def markdown(results: Results, found: Mapping) -> str:
    """A table for each group and recogniser, the slices, the conclusions, and what could not be had. found: the JSON's content."""
    lines = ["## At a glance", "", *_glance(results, found["groups"]), "", *NOTES, ""]
    for group, figures in zip(results.groups, found["groups"], strict=True):
        for recogniser in results.recognisers or ("",):
            lines += [f"## {heading(group, figures, recogniser)}", "", *_table(results, figures, recogniser), ""]
    lines += ["## What the source paper concluded", ""]
    lines += [f"- {one['conclusion']}: {one['verdict']}. {one['figures']}".strip() for one in found["conclusions"]]
    lines += ["", "## Where it fails", "", f"{'Capped WER, %' if results.recognisers else 'SI-SDR, dB'}.", ""]
    for one in found["slices"]:
        lines += [*_slice(results, one), ""]
    lines += ["## Rows that cannot be had here", ""]
    lines += [f"- {title}: {why}" for title, why in found["absent"].items()] or ["None."]
    return "\n".join(lines)


def _glance(results: Results, groups: Sequence[Mapping]) -> list[str]:
    """Systems down, groups across, one figure each: capped WER of the first recogniser, SI-SDR without one."""
    recogniser = next(iter(results.recognisers), "")
    found = {
        group.name: figures
        for group, figures in zip(results.groups, groups, strict=True)
        if any(_chief(row, recogniser) for row in figures["rows"].values())
    }
    digits = 0 if recogniser else 1
    rows = [
        [system.title, system.knows]
        + [interval(_chief(figures["rows"][system.name], recogniser), digits) for figures in found.values()]
        for system in results.systems
    ]
    heads = [f"{name} ({figures['clips']})" for name, figures in found.items()]
    said = f"Capped WER, %, {recogniser}" if recogniser else "SI-SDR, dB"
    return [f"{said}; of each set and room, with its number of clips.", "", *table(["system", "knows", *heads], rows)]


def _chief(row: Mapping, recogniser: str) -> Mapping | None:
    return (row["words"].get(recogniser) or {}).get("capped") if recogniser else row["si_sdr"]


def _slice(results: Results, one: Mapping) -> list[str]:
    titles = {system.name: system.title for system in results.systems}
    heads = [f"{part['slice']} ({counted(part['clips'], 'clip')})" for part in one["rows"]]
    digits = 0 if results.recognisers else 1
    rows = [
        [titles[name], *(interval(part["systems"][name], digits) for part in one["rows"])]
        for name in one["rows"][0]["systems"]
    ]
    return table([f"{one['title']}{', ' + one['unit'] if one['unit'] else ''}", *heads], rows)


def counted(count: int, what: str) -> str:
    """How many, in words: "1 clip", "2 clips"."""
    return f"{count} {what}" + ("s" if count != 1 else "")


def heading(group: Group, found: Mapping, recogniser: str) -> str:
    return f"{group.name}: {counted(found['clips'], 'clip')} of {counted(found['speakers'], 'speaker')}" + (
        f", {recogniser}" if recogniser else ""
    )


def _table(results: Results, group: Mapping, recogniser: str) -> list[str]:
    words = WORDS if recogniser else ()
    rows = [
        _cells(results, system.name, group["rows"][system.name], recogniser)
        for system in results.systems
        if group["rows"][system.name]["clips"]
    ]
    return table(["system", "knows", *words, *PLAIN, "less the best other"], rows)


def _cells(results: Results, name: str, row: Mapping, recogniser: str) -> list[str]:
    system = next(system for system in results.systems if system.name == name)
    unusable = f" ({row['problems']} outputs unusable)" if row["problems"] else ""
    cells = [system.title + unusable, system.knows]
    if recogniser:
        found = row["words"].get(recogniser)
        if found:
            wer = found["wer"]
            cells += [interval(wer, 0), number(wer["median"], 0), number(wer["std"], 0)]
            cells += [interval(found[key], 0) for key in ("pooled", "capped")]
            cells += [number(found[key]["mean"], 0) for key in ("insertions", "deletions")]
        else:
            cells += [""] * len(WORDS)
    ratio = row["si_sdr"]
    cells += [interval(ratio, 1), *(number(ratio[key], 1) for key in ("median", "std"))] if ratio else [""] * 3
    means = [(row[key] or {}).get("mean") for key in ("estoi", "erle_db", "echo_mos", "human_mos")]
    cells += [number(value, digits) for value, digits in zip(means, (2, 1, 1, 1), strict=True)]
    cells += [number(row["seconds_for_5s"], 2), latency(system)]
    return [*cells, _against(row["against"])]


def _against(found: Mapping) -> str:
    metric, digits = ("capped", 0) if found.get("capped") else ("si_sdr", 1)
    one = found.get(metric)
    return f"{interval(one, digits, 'difference')} ({one['other']})" if one else ""
