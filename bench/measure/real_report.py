"""Tables and the picture of the measurements on real devices."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from bench.measure.real_scores import ALONE_S, LOUD_DB
from bench.results_writer import table

IN_TIME_S = 0.3
"""Somebody who interrupts is to be noticed by then."""
LOW_SER, WARM_S = -20.0, 5.0
"""The summary's cases: human at most at this level against the echo, after at least so many seconds of robot alone."""
LINES = ("tab:gray", "tab:blue", "tab:green", "tab:red", "tab:orange", "tab:brown", "tab:purple", "tab:olive", "tab:pink")


def report(rows: list[dict], systems: Sequence[str], absent: dict[str, str], settings: dict) -> tuple[str, dict]:
    """The page below its head, and the content of the JSON file: settings, absent, summary by system, rows."""
    present = [system for system in systems if system not in absent]
    summary = {system: summarise([row for row in rows if row["system"] == system]) for system in present}
    lines = _overview(summary) + _absent(absent) + _pairs(rows, present) + _laid(rows, present) + _alone(rows, present) + _barge_in(rows, present)
    kept = {name: [str(part) for part in value] if isinstance(value, (list, tuple)) else value for name, value in settings.items() if not isinstance(value, Path)}
    return "\n".join(lines), {"settings": kept, "absent": absent, "summary": summary, "rows": rows}


def summarise(rows: list[dict]) -> dict:
    """One system in one line: what was measured of it, None where nothing was."""
    double = [row for row in rows if row["part"] == "pairs" and row["kind"] == "doubletalk"]
    hard = [row for row in rows if row["part"] == "laid" and row["ser"] <= LOW_SER and row["before"] >= WARM_S and not row["fan"]]
    alone = [row for row in rows if row["part"] == "alone"]
    ratios, erles = [row["si_sdr"] for row in hard], seconds(alone)
    asked = [row for row in rows if row["part"] == "laid" and row["ser"] == LOW_SER and row["before"] >= WARM_S and "early" in row]
    starts = [row["false_starts"] for row in alone if row["false_starts"] is not None]
    return {
        "echo_mos": mean(row["echo_mos"] for row in double),
        "human_mos": mean(row["human_mos"] for row in double),
        "cases": len(hard),
        "si_sdr": mean(ratios),
        "si_sdr_std": float(np.std(ratios)) if ratios else None,
        "si_sdr_worst": min(ratios, default=None),
        "below_microphone": sum(row["si_sdr"] < row["si_sdr_mic"] for row in hard),
        "wer_capped": mean(row.get("wer_capped") for row in hard),
        "erle_median": float(np.median(erles)) if erles else None,
        "erle_p10": float(np.quantile(erles, 0.1)) if erles else None,
        "excess_db": max((row["excess_db"] for row in rows), default=None),
        "false_starts": sum(starts) if starts else None,
        "alone_s": sum(row["seconds"] for row in alone),
        "in_time": mean(in_time(row) for row in asked),
    }


def mean(values: Iterable[float | None]) -> float | None:
    found = [value for value in values if value is not None]
    return float(np.mean(found)) if found else None


def seconds(alone: list[dict]) -> list[float]:
    """ERLE of every second in which the robot talks."""
    return [value for row in alone for value in row["erle_db"] if value is not None]


def in_time(row: dict) -> float:
    return float(row["delay_s"] is not None and row["delay_s"] <= IN_TIME_S)


def figure(value: float | None, digits: int = 1) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    return "" if value is None else f"{100 * value:.0f}"


def _overview(summary: dict[str, dict]) -> list[str]:
    columns = ["system", "double talk, AECMOS echo / human", "SI-SDR dB", "std", "worst", "below the microphone", "capped WER %"]
    columns += ["robot alone, ERLE dB median", "p10", "louder than the microphone, dB", "false starts", f"noticed in {IN_TIME_S} s, %"]
    rows = []
    for system, of in summary.items():
        mos = f"{figure(of['echo_mos'], 2)} / {figure(of['human_mos'], 2)}" if of["echo_mos"] is not None else ""
        starts = "" if of["false_starts"] is None else f"{of['false_starts']} in {of['alone_s'] / 60:.0f} min"
        below = f"{of['below_microphone']} of {of['cases']}" if of["cases"] else ""
        cells = [system, mos, figure(of["si_sdr"]), figure(of["si_sdr_std"]), figure(of["si_sdr_worst"]), below, percent(of["wer_capped"])]
        rows.append([*cells, figure(of["erle_median"]), figure(of["erle_p10"]), figure(of["excess_db"]), starts, percent(of["in_time"])])
    said = f"SI-SDR and word errors: humans laid on the robot at {LOW_SER:.0f} dB or less, after {WARM_S:.0f} s or more of it, no fan. Louder than"
    said += f" the microphone: the most over any second of anything here. Noticed: humans at {LOW_SER:.0f} dB after {WARM_S:.0f} s or more, fan or none."
    return ["## In one table", "", *table(columns, rows), "", said, ""]


def _absent(absent: dict[str, str]) -> list[str]:
    return [*(f"- absent: {name}: {why}" for name, why in absent.items()), ""] if absent else []


def _pairs(rows: list[dict], systems: Sequence[str]) -> list[str]:
    lines = []
    pairs = [row for row in rows if row["part"] == "pairs"]
    for kind, extra, what in (("doubletalk", None, "AECMOS echo / human"), ("farend", "erle_db", "AECMOS echo, ERLE dB"), ("nearend", "si_sdr", "AECMOS human, SI-SDR dB")):
        own = [row for row in pairs if row["kind"] == kind]
        names = list(dict.fromkeys(row["name"] for row in own))
        if names:
            found = {(row["name"], row["system"]): row for row in own}
            body = [[name, *(_mos(found[name, system], kind, extra) for system in systems)] for name in names]
            lines += [f"## Pairs as recorded, {kind}: {what}", "", *table(["recording", *systems], body), ""]
    return lines


def _mos(row: dict, kind: str, extra: str | None) -> str:
    echo, human = figure(row["echo_mos"], 2), figure(row["human_mos"], 2)
    if extra is None:
        return f"{echo} / {human}"
    return f"{echo if kind == 'farend' else human}, {figure(row[extra])}"


def _laid(rows: list[dict], systems: Sequence[str]) -> list[str]:
    laid = [row for row in rows if row["part"] == "laid"]
    if not laid:
        return []
    cases = len({row["case"] for row in laid})
    lines = [f"## Humans laid on the robot, {cases} in each cell", ""]
    said = f"Mean SI-SDR dB over the human's span (std); ERLE dB, median, over up to {ALONE_S:.0f} s of robot alone just before; output over"
    lines += [f"{said} microphone in the human's span, dB{'; capped WER' if any('wer_capped' in row for row in laid) else ''}.", ""]
    cells = sorted({(row["fan"], row["before"], -row["ser"]) for row in laid})
    body = []
    for fan, before, ser in cells:
        own = [row for row in laid if (row["fan"], row["before"], -row["ser"]) == (fan, before, ser)]
        cell = [_cell([row for row in own if row["system"] == system]) for system in systems]
        body.append(["fan" if fan else "no fan", f"{before:.0f}", f"{-ser:.0f}", *cell])
    return [*lines, *table(["", "s before", "SER dB", *systems], body), ""]


def _cell(rows: list[dict]) -> str:
    ratios, erles = [row["si_sdr"] for row in rows], [row["erle_db"] for row in rows if row["erle_db"] is not None]
    parts = [f"{np.mean(ratios):.1f} ({np.std(ratios):.1f})", *([f"{np.median(erles):.1f}"] if erles else []), f"{np.mean([row['level_db'] for row in rows]):.1f}"]
    errors = mean(row.get("wer_capped") for row in rows)
    return "; ".join(parts + ([f"{percent(errors)} %"] if errors is not None else []))


def _alone(rows: list[dict], systems: Sequence[str]) -> list[str]:
    alone = [row for row in rows if row["part"] == "alone"]
    if not alone:
        return []
    said = f"ERLE dB of each second within {LOUD_DB:.0f} dB of the recording's loudest: median / 10 % lowest; [most by which the output is louder than the"
    body = []
    for name in dict.fromkeys(row["name"] for row in alone):
        own = {row["system"]: row for row in alone if row["name"] == name}
        body.append([name, *(_erle(own[system]) for system in systems)])
    return ["## The robot alone", "", f"{said} microphone over a second, dB].", "", *table(["recording", *systems], body), ""]


def _erle(row: dict) -> str:
    median, low = np.quantile(seconds([row]), [0.5, 0.1])
    return f"{median:.1f} / {low:.1f} [{row['excess_db']:.1f}]"


def _barge_in(rows: list[dict], systems: Sequence[str]) -> list[str]:
    """Of the systems that judge who speaks."""
    body = []
    for system in systems:
        own = [row for row in rows if row["system"] == system]
        alone = [row for row in own if row["part"] == "alone" and row["false_starts"] is not None]
        minutes, starts = sum(row["seconds"] for row in alone) / 60, sum(row["false_starts"] for row in alone)
        if alone:
            by_file = ", ".join(str(row["false_starts"]) for row in alone)
            body.append([system, "robot alone", f"{starts} in {minutes:.0f} min ({by_file}), {60 * starts / minutes:.0f} an hour", "", "", "", ""])
        for before in sorted({row["before"] for row in own if "early" in row}):
            for ser in sorted({row["ser"] for row in own if "early" in row}, reverse=True):
                cell = [row for row in own if row.get("early") is not None and row["before"] == before and row["ser"] == ser]
                body.append([system, f"SER {ser:.0f} dB after {before:.0f} s", "", *_notices(cell)])
    if not body:
        return []
    columns = ["system", "stream", "false speech_started", f"noticed in {IN_TIME_S} s", "median delay ms", "already on", "never"]
    return ["## Barge-in", "", "Delay from the human's first sound; a median over all, those already on or never noticed as infinitely late.", "", *table(columns, body), ""]


def _notices(rows: list[dict]) -> list[str]:
    delays = [np.inf if row["delay_s"] is None else row["delay_s"] for row in rows]
    median = 1000 * float(np.quantile(delays, 0.5, method="higher"))
    early = sum(row["early"] for row in rows)
    share = f"{sum(in_time(row) for row in rows):.0f} of {len(rows)}"
    return [share, f"{median:.0f}" if np.isfinite(median) else "never", str(early), str(sum(row["delay_s"] is None for row in rows) - early)]


def picture(rows: list[dict], systems: Sequence[str], output: Path) -> None:
    """OUTPUT.png: ERLE over the time since the stream began, and SI-SDR by the human's level against the echo."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure_, (left, right) = pyplot.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    for colour, system in zip(LINES * 2, systems, strict=False):
        own = [row for row in rows if row["system"] == system]
        alone = [row["erle_db"] for row in own if row["part"] == "alone"]
        if alone:
            times = range(max(map(len, alone)))
            left.plot(times, [mean(erle[t] for erle in alone if t < len(erle)) or np.nan for t in times], color=colour, label=system, linewidth=1.2)
        laid = [row for row in own if row["part"] == "laid" and row["before"] >= WARM_S and not row["fan"]]
        sers = sorted({row["ser"] for row in laid})
        if sers:
            right.plot(sers, [mean(row["si_sdr"] for row in laid if row["ser"] == ser) for ser in sers], "o-", color=colour, label=system)
    left.set(xlabel="seconds since the stream began", ylabel="ERLE, dB", title="The robot alone (mean over recordings)")
    right.set(xlabel="human over echo, dB", ylabel="SI-SDR, dB", title=f"Humans laid on it after {WARM_S:.0f} s or more, no fan")
    for axes in (left, right):
        axes.grid(alpha=0.3)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8)
    figure_.savefig(output.parent / f"{output.name}.png", dpi=110)
    pyplot.close(figure_)
