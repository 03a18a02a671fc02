"""Tables and the picture of the measurements on recordings of real devices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from bench.measure.picture import panels, save
from bench.measure.real_barge_in import IN_TIME_S, in_time
from bench.measure.real_scores import ALONE_S, LOUD_DB
from bench.measure.real_summary import LOW_SER, WARM_S, curve, mean, seconds, summarise
from bench.results_writer import table

LINES = ("tab:gray", "tab:blue", "tab:green", "tab:red", "tab:orange", "tab:brown", "tab:purple", "tab:olive")
PAIRS = {
    "doubletalk": ("both talk", "AECMOS echo / human"),
    "farend": ("the robot alone", "AECMOS echo; ERLE dB"),
    "nearend": ("the human alone", "AECMOS human; SI-SDR against the microphone, dB"),
}


def report(rows: list[dict], systems: Sequence[str], absent: Mapping[str, str]) -> tuple[str, dict]:
    """The page below its head, and the content of the JSON file: absent, summary by system, rows."""
    present = [system for system in systems if system not in absent]
    summary = {system: summarise([row for row in rows if row["system"] == system]) for system in present}
    lines = _overview(summary) + _absent(absent)
    for part in (_pairs, _laid, _alone, _barge_in):
        lines += part(rows, present)
    return "\n".join(lines), {"absent": dict(absent), "summary": summary, "rows": rows}


def figure(value: float | None, digits: int = 1) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    return "" if value is None else f"{100 * value:.0f}"


def _overview(summary: Mapping[str, dict]) -> list[str]:
    columns = [
        "system",
        "AECMOS echo / human",
        "SI-SDR dB",
        "std (at one level)",
        "worst",
        "below the microphone",
        "capped WER %",
    ]
    columns += ["ERLE dB median", "p10", "louder dB", "false starts", f"noticed in {IN_TIME_S} s, %"]
    body = []
    for system, of in summary.items():
        mos = f"{figure(of['echo_mos'], 2)} / {figure(of['human_mos'], 2)}" if of["echo_mos"] is not None else ""
        starts = "" if of["false_starts"] is None else f"{of['false_starts']} in {of['alone_s'] / 60:.0f} min"
        below = f"{of['below_microphone']} of {of['cases']}" if of["cases"] else ""
        spread = f"{figure(of['si_sdr_std'])} ({figure(of['si_sdr_std_level'])})" if of["cases"] else ""
        hard = [figure(of["si_sdr"]), spread, figure(of["si_sdr_worst"]), below, percent(of["wer_capped"])]
        alone = [figure(of["erle_median"]), figure(of["erle_p10"]), figure(of["excess_db"]), starts]
        body.append([system, mos, *hard, *alone, percent(of["in_time"])])
    notes = [
        "- AECMOS: mean over the pairs in which both talk.",
        f"- SI-SDR to word errors: laid humans at {LOW_SER:.0f} dB or less, after {WARM_S:.0f} s or more, no fan.",
        f"- ERLE: the robot alone, each second within {LOUD_DB:.0f} dB of its recording's loudest.",
        "- Louder: the most by which the output exceeded the microphone over any second of anything measured here.",
        f"- False starts: `speech_started` alone. Noticed: laid humans at {LOW_SER:.0f} dB, after {WARM_S:.0f} s.",
    ]
    return ["## In one table", "", *table(columns, body), "", *notes, ""]


def _absent(absent: Mapping[str, str]) -> list[str]:
    return ["Absent:", "", *(f"- {name}: {why}" for name, why in absent.items()), ""] if absent else []


def _pairs(rows: list[dict], systems: Sequence[str]) -> list[str]:
    lines = []
    for kind, (who, what) in PAIRS.items():
        own = {(row["name"], row["system"]): row for row in rows if row["part"] == "pairs" and row["kind"] == kind}
        names = dict.fromkeys(name for name, _ in own)
        if names:
            body = [[name, *(_pair(own[name, system], kind) for system in systems)] for name in names]
            lines += [f"## As recorded, {who}: {what}", "", *table(["recording", *systems], body), ""]
    return lines


def _pair(row: dict, kind: str) -> str:
    echo, human = figure(row["echo_mos"], 2), figure(row["human_mos"], 2)
    if kind == "doubletalk":
        return f"{echo} / {human}"
    return f"{echo}; {figure(row['erle_db'])}" if kind == "farend" else f"{human}; {figure(row['si_sdr'])}"


def _laid(rows: list[dict], systems: Sequence[str]) -> list[str]:
    laid = [row for row in rows if row["part"] == "laid"]
    if not laid:
        return []
    cells: dict[tuple, dict[str, list[dict]]] = {}
    for row in sorted(laid, key=lambda row: (row["fan"], row["before"], -row["ser"])):
        key = ("fan" if row["fan"] else "no fan", f"{row['before']:.0f}", f"{row['ser']:.0f}")
        cells.setdefault(key, {}).setdefault(row["system"], []).append(row)
    errors = any("wer_capped" in row for row in laid)
    body = [[*key, *(_cell(own[system]) for system in systems)] for key, own in cells.items()]
    said = [
        f"{len({row['case'] for row in laid})} in each cell. Mean SI-SDR dB in the human's span (std); median ERLE dB",
        f"in the {ALONE_S:.0f} s of robot alone just before (nobody can tell echo from human in a nonlinear output);",
        f"output over microphone, dB, in the human's span{'; capped WER' if errors else ''}.",
    ]
    columns = ["", "s alone before", "SER dB", *systems]
    return ["## Humans laid on the robot", "", *said, "", *table(columns, body), ""]


def _cell(rows: list[dict]) -> str:
    ratios, erles = [row["si_sdr"] for row in rows], [row["erle_db"] for row in rows if row["erle_db"] is not None]
    parts = [f"{np.mean(ratios):.1f} ({np.std(ratios):.1f})"]
    if erles:
        parts.append(f"{np.median(erles):.1f}")
    parts.append(figure(mean(row["level_db"] for row in rows)))
    errors = mean(row.get("wer_capped") for row in rows)
    return "; ".join(parts if errors is None else [*parts, f"{percent(errors)} %"])


def _alone(rows: list[dict], systems: Sequence[str]) -> list[str]:
    own = {(row["name"], row["system"]): row for row in rows if row["part"] == "alone"}
    names = dict.fromkeys(name for name, _ in own)
    if not names:
        return []
    said = (
        "ERLE dB, median / 10 % lowest second; [the most by which it is louder than the microphone over a second, dB]."
    )
    body = [[name, *(_erle(own[name, system]) for system in systems)] for name in names]
    return ["## The robot alone", "", said, "", *table(["recording", *systems], body), ""]


def _erle(row: dict) -> str:
    median, low = np.quantile(seconds([row]), [0.5, 0.1])
    return f"{median:.1f} / {low:.1f} [{row['excess_db']:.1f}]"


def _barge_in(rows: list[dict], systems: Sequence[str]) -> list[str]:
    """Of the systems that judge who speaks."""
    body = []
    for system in systems:
        own = [row for row in rows if row["system"] == system]
        alone = [row for row in own if "false_starts" in row]
        if alone:
            starts, hours = [row["false_starts"] for row in alone], sum(row["seconds"] for row in alone) / 3600
            counts = f"{sum(starts)} ({', '.join(map(str, starts))}), {sum(starts) / hours:.0f} an hour"
            body.append([system, f"{60 * hours:.0f} min of robot alone", counts, *[""] * 4])
        asked: dict[tuple, list[dict]] = {}
        for row in sorted((row for row in own if "early" in row), key=lambda row: (row["before"], -row["ser"])):
            asked.setdefault((row["before"], row["ser"]), []).append(row)
        body += [
            [system, f"{ser:.0f} dB after {before:.0f} s", "", *_notices(cell)] for (before, ser), cell in asked.items()
        ]
    if not body:
        return []
    columns = [
        "system",
        "heard",
        "false starts (by recording)",
        f"noticed in {IN_TIME_S} s",
        "median ms",
        "already on",
        "never",
    ]
    said = "Delay from the human's first sound, with and without fan; already on and never count as infinitely late."
    return ["## Barge-in", "", said, "", *table(columns, body), "", *_curves(rows, systems)]


def _curves(rows: list[dict], systems: Sequence[str]) -> list[str]:
    """Each judging system at other thresholds of its probability."""
    points = [
        (system, point) for system in systems for point in curve([row for row in rows if row["system"] == system])
    ]
    if not points:
        return []
    body = [[system, at["threshold"], f"{at['false_an_hour']:.0f}", percent(at["in_time"])] for system, at in points]
    said = "The same at other thresholds of the probability, all else as shipped; noticed as in the first table."
    return [said, "", *table(["system", "threshold", "false starts an hour", f"noticed in {IN_TIME_S} s, %"], body), ""]


def _notices(rows: list[dict]) -> list[str]:
    delays = [np.inf if row["delay_s"] is None else row["delay_s"] for row in rows]
    median = 1000 * float(np.quantile(delays, 0.5, method="higher"))
    early, late = sum(row["early"] for row in rows), sum(row["delay_s"] is None for row in rows)
    share = f"{sum(map(in_time, rows)):.0f} of {len(rows)}"
    return [share, f"{median:.0f}" if np.isfinite(median) else "never", str(early), str(late - early)]


def picture(rows: list[dict], systems: Sequence[str], output: Path) -> None:
    """OUTPUT.png: ERLE over time; SI-SDR by the human's level against the echo; false starts against humans noticed."""
    drawing, axes = panels(1, 3, (15, 4.2))
    for colour, system in zip(LINES * (1 + len(systems) // len(LINES)), systems, strict=False):
        _draw(axes, [row for row in rows if row["system"] == system], {"color": colour, "label": system})
    left, middle, right = axes
    left.set(xlabel="seconds since the stream began", ylabel="ERLE, dB", title="The robot alone (mean over recordings)")
    title = f"Humans laid on it after {WARM_S:.0f} s or more, no fan"
    middle.set(xlabel="human over echo, dB", ylabel="SI-SDR, dB", title=title)
    title = "Barge-in: by threshold of the probability; x: as shipped"
    right.set(
        xlabel="false starts an hour",
        ylabel=f"noticed in {IN_TIME_S} s at {LOW_SER:.0f} dB",
        title=title,
        ylim=(-0.03, 1.03),
    )
    for panel in axes:
        panel.grid(alpha=0.3)
        if panel.get_legend_handles_labels()[0]:
            panel.legend(fontsize=8)
    save(drawing, output, dpi=110)


def _draw(axes: Sequence, rows: list[dict], style: Mapping[str, str]) -> None:
    """One system in all three panels, where it was measured."""
    erles = [row["erle_db"] for row in rows if row["part"] == "alone"]
    if erles:
        axes[0].plot(_by_second(erles), linewidth=1.2, **style)
    laid = [row for row in rows if row["part"] == "laid" and row["before"] >= WARM_S and not row["fan"]]
    sers = sorted({row["ser"] for row in laid})
    if sers:
        ratios = [mean(row["si_sdr"] for row in laid if row["ser"] == ser) for ser in sers]
        axes[1].plot(sers, ratios, "o-", **style)
    points, of = curve(rows), summarise(rows)
    if points:
        axes[2].plot([at["false_an_hour"] for at in points], [at["in_time"] for at in points], ".-", **style)
        shipped = 3600 * of["false_starts"] / of["alone_s"]
        axes[2].plot(shipped, of["in_time"], "x", color=style["color"], markersize=10)


def _by_second(erles: list[list[float | None]]) -> list[float]:
    """Mean over recordings of each second; nan, a gap in the line, where the robot talks in none."""
    found = [mean(erle[second] for erle in erles if second < len(erle)) for second in range(max(map(len, erles)))]
    return [np.nan if value is None else value for value in found]
