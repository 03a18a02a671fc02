"""The evaluation as one HTML file that holds its pictures and its sound, and needs no network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from bench.evaluate.facts import QUANTITIES
from bench.evaluate.figures import Results
from bench.evaluate.slices import metric_of
from bench.evaluate.systems import TRUE_LAG, System
from bench.evaluate.table import counted, heading, interval, latency, number
from bench.evaluate.worst import looked_at


@dataclass(frozen=True)
class Column:
    """A column of the page's tables: where its figure is, and which end is better (+1, -1, 0: neither)."""

    title: str
    path: tuple[str, ...]
    digits: int
    better: int
    bars: bool = False


RATIOS = (
    Column("SI-SDR, dB", ("si_sdr",), 1, 1, bars=True),
    Column("ESTOI", ("estoi", "mean"), 2, 1),
    Column("ERLE, dB", ("erle_db", "mean"), 1, 1),
    Column("MOS echo", ("echo_mos", "mean"), 1, 1),
    Column("MOS human", ("human_mos", "mean"), 1, 1),
    Column("5 s take, s", ("seconds_for_5s",), 2, -1),
)
WER_TOP = 100.0


def columns(results: Results) -> list[Column]:
    """Capped word errors of every recogniser first, then the others."""
    words = [
        column
        for name in results.recognisers
        for column in (
            Column(f"Capped WER, %: {name}", ("words", name, "capped"), 0, -1, bars=True),
            Column("put in", ("words", name, "insertions", "mean"), 0, -1),
            Column("left out", ("words", name, "deletions", "mean"), 0, -1),
        )
    ]
    return [*words, *RATIOS]


def page(results: Results, content: Mapping[str, Any], worst: Sequence[Mapping], made_with: Mapping) -> str:
    """All of it. content: groups, absent, slices and conclusions as the JSON file has them; worst: from `worst.show`."""
    chosen = columns(results)
    groups = [_group(results, group, found, chosen) for group, found in zip(results.groups, content["groups"])]
    system = looked_at(results)
    fields = {
        "headline": headline(results),
        "date": made_with["date"],
        "commit": made_with["commit"][:12],
        "dirty": made_with["dirty"],
        "facts": _facts(results, content["absent"]),
        "groups": groups,
        "columns": [{"title": column.title, "bars": column.bars} for column in chosen]
        + [{"title": "Latency, ms", "bars": False}],
        "conclusions": content["conclusions"],
        "measure": "Capped word error rate, %" if metric_of(results) == "capped" else "SI-SDR, dB",
        "slices": [_slice(results, one) for one in content["slices"]],
        "looked_at": system.title if system else "",
        "worst": [_worst(clip) for clip in worst],
        "absent": list(content["absent"].items()),
        "stamp": _stamp(made_with),
        "command": made_with["command"],
        "style": resources.files("edgefilter.report").joinpath("page.css").read_text(encoding="utf-8")
        + Path(__file__).with_suffix(".css").read_text(encoding="utf-8"),
    }
    made = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, keep_trailing_newline=True)
    return made.from_string(Path(__file__).with_suffix(".html").read_text(encoding="utf-8")).render(fields)


def headline(results: Results) -> str:
    """Who is best in how many of the tables."""
    metric = metric_of(results)
    best = [name for group in results.groups if (name := group.best(metric))]
    if not best:
        return "Nothing could be compared"
    titles = {system.name: system.title for system in results.systems}
    counts = sorted({name: best.count(name) for name in best}.items(), key=lambda item: -item[1])
    what = "the fewest word errors" if metric == "capped" else "the highest SI-SDR"
    (first, count), *others = counts
    rest = "".join(f"; {titles[name]} in {number_of}" for name, number_of in others)
    return f"{titles[first]} has {what} in {count} of {len(best)} tables{rest}"


def _facts(results: Results, absent: Mapping) -> list[tuple[str, str, str]]:
    speakers = {clip.speaker for clip in results.clips if clip.speaker}
    places = {clip.place for clip in results.clips}
    words = sum(len((clip.text or "").split()) for clip in results.clips)
    return [
        ("Recordings", str(len(results.clips)), f"in {len(places)} places"),
        ("Humans", str(len(speakers)), f"who say {words} words"),
        ("Systems", str(len(results.systems)), f"and {len(absent)} that cannot be had"),
        ("Recognisers", str(len(results.recognisers)), ", ".join(results.recognisers) or "no word errors"),
    ]


def _group(results: Results, group: Any, found: Mapping, chosen: Sequence[Column]) -> dict:
    systems = [system for system in results.systems if found["rows"][system.name]["clips"]]
    picked = [_column(systems, found["rows"], column) for column in chosen]
    rows, kind = [], ""
    for at, system in enumerate(systems):
        cells = [*(cells[at] for cells in picked), {"text": latency(system), "bars": False, "best": False}]
        rows.append({"title": system.title, "knows": system.knows, "kind": system.kind, "cells": cells})
        rows[-1]["first"] = system.kind != kind
        kind = system.kind
    return {"title": heading(group, found, ""), "best": _best(results, group), "rows": rows}


def _best(results: Results, group: Any) -> str:
    """In words: who is best, and how much that is worth against the next."""
    metric = metric_of(results)
    name = group.best(metric)
    other = group.best(metric, besides=name) if name else None
    if not name or not other:
        return ""
    titles = {system.name: system.title for system in results.systems}
    found = group.difference(name, other, metric)
    if found is None:
        return f"Best: {titles[name]}."
    unit = "points of capped WER" if metric == "capped" else "dB"
    return f"Best: {titles[name]}; less the next, {titles[other]}: {interval(found, 1, 'difference')} {unit}."


def _column(systems: Sequence[System], rows: Mapping, column: Column) -> list[dict]:
    """A cell for each system, with dot and interval on the column's own scale."""
    found = [_at(rows[system.name], column.path) for system in systems]
    values = [one["mean"] if isinstance(one, Mapping) else one for one in found]
    can_have = [
        value
        for value, system in zip(values, systems)
        if value is not None and system.kind != "bound" and system.knows != TRUE_LAG
    ]
    best = (max(can_have) if column.better > 0 else min(can_have)) if len(set(can_have)) > 1 else None
    scale = _scale([one for one in found if isinstance(one, Mapping)], column) if column.bars else (0.0, 1.0)
    cells = []
    for one, value, system in zip(found, values, systems):
        robot = system.kind != "bound" and system.knows != TRUE_LAG
        shown = number(value, column.digits)
        cell: dict = {
            "text": shown,
            "bars": column.bars,
            "at": None,
            "best": robot and value is not None and value == best,
        }
        if column.bars and isinstance(one, Mapping):
            low, at, high = (100 * (value - scale[0]) / (scale[1] - scale[0]) for value in _ends(one))
            cell |= {"at": round(at, 2), "low": round(low, 2), "width": round(high - low, 2)}
            cell["text"] = interval(one, column.digits)
        cells.append(cell)
    return cells


def _ends(one: Mapping) -> tuple[float, float, float]:
    """Low, mean and high; the mean thrice where there is no interval."""
    mean = one["mean"]
    return (mean, mean, mean) if one["low"] is None else (one["low"], mean, one["high"])


def _at(row: Any, path: Sequence[str]) -> Any:
    for key in path:
        row = (row or {}).get(key)
    return row


def _scale(found: Sequence[Mapping], column: Column) -> tuple[float, float]:
    if column.path[-1] == "capped" or not found:
        return 0.0, WER_TOP
    low, high = min(_ends(one)[0] for one in found), max(_ends(one)[2] for one in found)
    return low - 1.0, high + 1.0


def _slice(results: Results, one: Mapping) -> dict:
    """Systems down, slices across; how bad a cell is, from 0 to 100, is its colour."""
    titles = {system.name: system.title for system in results.systems}
    means = [found["mean"] for part in one["rows"] for found in part["systems"].values() if found]
    low, high = (0.0, WER_TOP) if metric_of(results) == "capped" else (min(means), max(means) + 1e-9)
    digits = 0 if metric_of(results) == "capped" else 1

    def cell(found: Mapping | None) -> dict | None:
        if not found:
            return None
        share = 100 * (found["mean"] - low) / (high - low)
        ends = "" if found["low"] is None else f"{found['low']:.{digits}f} to {found['high']:.{digits}f}"
        return {"mean": f"{found['mean']:.{digits}f}", "ends": ends} | {
            "bad": round(share if metric_of(results) == "capped" else 100 - share)
        }

    names = list(one["rows"][0]["systems"])
    lines = [(titles[name], [cell(part["systems"][name]) for part in one["rows"]]) for name in names]
    heads = [{"slice": part["slice"], "clips": counted(part["clips"], "clip")} for part in one["rows"]]
    return {**one, "rows": heads, "lines": lines}


def _worst(clip: Mapping) -> dict:
    known = {quantity.key: quantity for quantity in QUANTITIES}
    facts = [
        f"{known[key].title}: {value if isinstance(value, str) else f'{value:.{known[key].digits}f}'} {known[key].unit}"
        for key, value in clip["facts"].items()
    ]
    heard = [{**one, "wer": f"{one['wer']:.0f} %"} for one in clip["heard"]]
    onset = round(100 * clip["human_s"] / clip["seconds"], 2)
    return {**clip, "facts": "; ".join(fact.strip() for fact in facts), "heard": heard, "onset": onset}


def _stamp(made_with: Mapping) -> str:
    read = [f"{one['what']}/{one['folder']} ({one['files']} files, {one['sha256'][:12]})" for one in made_with["data"]]
    read += [f"{name} ({one['sha256'][:12]})" for name, one in made_with["models"].items()]
    return f"Data and models (sha256): {', '.join(read)}. " + ", ".join(
        f"{key} {value}" for key, value in made_with["machine"].items()
    )
