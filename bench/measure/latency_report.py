"""The page and the picture of latency.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from bench.measure import picture
from edgefilter.types import SAMPLE_RATE

AIMS = {"crnn": ((1.5, 5.0), (0.8, 2.0), (0.06, 0.03)), "ss": ((0.6, 2.0), (0.3, 1.0), (0.025, 0.012))}
"""What was asked for, as (p50, p99) ms paced: within reach, aimed at; and the real-time factor likewise."""

FRONT_AIM = 0.3
"""ms, p50 of alignment and canceller of a 16 ms hop on one core, with a tail of 400 ms."""


def markdown(result: dict, name: str) -> str:
    """The page below its head; name: of the picture beside it, without suffix."""
    rows = result["rows"]
    lines = [", ".join(f"{key} {value}" for key, value in result["conditions"].items()) + ".", ""]
    lines += [
        f"{result['rounds']} round(s) of {result['seconds']:g} s of the bundled conversation for each row, contenders "
        "in turns, every"
    ]
    lines += [
        "process held to two cores, warm-up (0.5 s) left out. Paced: a hop begins when a device would deliver it. "
        "Busy: a second process on"
    ]
    lines += [
        (
            "each core that never rests; measured paced and with one thread only. Missed: hops that took longer than"
            " they last. RTF: compute over audio."
        ),
        "",
    ]
    lines += [f"{contender} is not in the table: {why}" for contender, why in result["missing"].items()]
    lines += [
        "",
        "| | hop ms | load | threads | pace | p50 | p95 | p99 | max, ms per hop | missed | RTF |",
        "| --- " * 11 + "|",
    ]
    lines += [_row(row) for row in sorted(rows, key=lambda row: (row["busy"], row["threads"], not row["paced"]))]
    lines += _aims(rows) + _stages(rows) + _slowest(rows) + _waits(result) + _curves(result["curves"])
    return "\n".join([*lines, "", f"![latency]({name}.png)", ""])


def _q(row: dict, percent: float) -> float:
    return row["quantiles"][str(percent)]


def _row(row: dict) -> str:
    times = " | ".join(f"{_q(row, percent):.3f}" for percent in (50, 95, 99, 100))
    place = f"{'busy' if row['busy'] else 'idle'} | {row['threads']} | {'paced' if row['paced'] else 'back to back'}"
    name = f"{row['contender']} | {1000 * row['hop'] / SAMPLE_RATE:g}"
    return f"| {name} | {place} | {times} | {row['missed']} of {row['hops']} | {row['real_time_factor']:.4f} |"


def _find(rows: list[dict], paced: bool, busy: bool = False) -> dict[str, dict]:
    return {
        row["contender"]: row for row in rows if row["paced"] == paced and row["busy"] == busy and row["threads"] == 1
    }


def _aims(rows: list[dict]) -> list[str]:
    lines = [
        "",
        "## Against the aims",
        "",
        "| | figure | found | within reach | aim |",
        "| --- | --- | --- | --- | --- |",
    ]
    paced, at_once = _find(rows, True), _find(rows, False)
    for name, (reach, aim, factor) in AIMS.items():
        if name in paced:
            for percent, far, near in zip((50, 99), reach, aim):
                lines.append(
                    f"| {name} | p{percent} of a paced hop, ms | {_q(paced[name], percent):.2f} | {far:g} | {near:g} |"
                )
            lines.append(
                f"| {name} | real-time factor back to back | {at_once[name]['real_time_factor']:.4f} "
                f"| {factor[0]:g} | {factor[1]:g} |"
            )
    for found, pace in ((at_once, "back to back"), (paced, "paced")):
        name, row = next((name, found[name]) for name in ("linear", *AIMS) if name in found)
        lines.append(
            f"| {name} | alignment and canceller {pace}, p50 (p99), ms "
            f"| {_q(row['front'], 50):.2f} ({_q(row['front'], 99):.2f}) | | {FRONT_AIM:g} |"
        )
    return lines


def _stages(rows: list[dict]) -> list[str]:
    lines = [
        "",
        "## What the time is made of",
        "",
        "Idle, one thread; mean ms per hop, and p99 in brackets. 'rest' is Python between the stages.",
    ]
    lines += ["The floor is `bypass`: STFT, overlap-add and the stream around them.", ""]
    for paced in (False, True):
        found = {name: row for name, row in _find(rows, paced).items() if row["stages"]}
        stages = list(max(found.values(), key=lambda row: len(row["stages"]))["stages"])
        lines += [
            f"| {'paced' if paced else 'back to back'} | {' | '.join(stages)} | rest | whole |",
            "| --- " * (len(stages) + 3) + "|",
        ]
        for name, row in found.items():
            cells = [
                f"{row['stages'][s]['mean']:.3f} ({_q(row['stages'][s], 99):.2f})" if s in row["stages"] else ""
                for s in stages
            ]
            rest = row["mean"] - sum(part["mean"] * part["hops"] for part in row["stages"].values()) / row["hops"]
            lines.append(f"| {name} | {' | '.join(cells)} | {rest:.3f} | {row['mean']:.3f} ({_q(row, 99):.2f}) |")
        lines.append("")
    paced, at_once = _find(rows, True), _find(rows, False)
    ratios = ", ".join(f"{name} {_q(paced[name], 50) / _q(at_once[name], 50):.1f}" for name in paced)
    return [*lines, f"Cold caches and a processor that has to wake up: paced p50 over back-to-back p50: {ratios}."]


def _slowest(rows: list[dict]) -> list[str]:
    lines = [
        "",
        "## The ten slowest hops",
        "",
        "Paced, idle, one thread: second in the conversation, ms, and the stage that took most of it.",
    ]
    for name, row in _find(rows, True).items():
        stages = [f" ({hop['stage']} {hop['stage_ms']:.1f})" if hop["stage"] else "" for hop in row["slowest"]]
        lines += [
            "",
            f"- {name}: "
            + ", ".join(f"{hop['second']:.2f} s {hop['ms']:.1f}{stage}" for hop, stage in zip(row["slowest"], stages)),
        ]
    return lines


def _waits(result: dict) -> list[str]:
    lines = ["", "## What a user waits for", ""]
    lines += [
        "| | start to first filtered hop, s (median) | memory then, MB | memory at the end, MB |",
        "| --- " * 4 + "|",
    ]
    paced = _find(result["rows"], True)
    for name, starts in result["start"].items():
        seconds, memory = (np.median([start[key] for start in starts]) for key in ("seconds", "memory_mb"))
        lines.append(f"| {name} | {seconds:.2f} | {memory:.0f} | {paced[name]['peak_memory_mb']:.0f} |")
    if result["click"]:
        alone = np.nanmedian(result["click"]["devices alone"])
        lines += [
            "",
            (
                "From a click at the microphone to the click at the output, through virtual devices (PulseAudio, "
                "PortAudio over ALSA);"
            ),
        ]
        lines += ["the declared latency is the window, and a hop has to be complete before it is filtered.", ""]
        lines += ["| | ms (median) | lowest - highest | beyond the devices |", "| --- | --- | --- | --- |"]
        for name, times in result["click"].items():
            middle = np.nanmedian(times)
            lines.append(
                f"| {name} | {middle:.0f} | {np.nanmin(times):.0f} - {np.nanmax(times):.0f} | {middle - alone:+.0f} |"
            )
    return lines


def _curves(curves: dict[str, list[dict]]) -> list[str]:
    lines = ["", "## How the cost grows", "", "Back to back, one thread, `ss` (model size: `crnn`)."]
    for axis, title in (("tail", "taps of the linear stage"), ("hop", "hop, samples"), ("model", "model file, bytes")):
        if curves[axis]:
            lines += ["", f"| {title} | p50 | p99, ms per hop | RTF |", "| --- | --- | --- | --- |"]
            lines += [
                f"| {row['x']} | {_q(row, 50):.3f} | {_q(row, 99):.3f} | {row['real_time_factor']:.4f} |"
                for row in curves[axis]
            ]
    return lines


def draw(result: dict, output: Path) -> None:
    """Distributions of the paced hop, idle and busy, what it is made of, and the curves."""
    figure, axes = picture.panels(2, 3, (15, 8.4))
    for axis, busy in zip(axes, (False, True)):
        for number, (name, row) in enumerate(_find(result["rows"], True, busy).items()):
            percent = [float(key) for key in row["quantiles"]]
            axis.plot(
                [max(100 - p, 0.05) for p in percent],
                list(row["quantiles"].values()),
                color=f"C{number}",
                label=name,
                lw=1.2,
            )
        axis.set(xscale="log", yscale="log", xlabel="hops slower than this, %", ylabel="ms per hop")
        axis.set_title("paced, both cores busy" if busy else "paced, idle")
        axis.invert_xaxis()
        axis.axhline(16, color="0.6", lw=0.8, ls=":")
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8, loc="best")
    _draw_stages(axes[2], _find(result["rows"], True))
    titles = {"tail": "taps of the linear stage", "hop": "hop, samples", "model": "model file, MB"}
    for axis, (panel, title) in zip(axes[3:], titles.items(), strict=True):
        x = [row["x"] / (1e6 if panel == "model" else 1) for row in result["curves"][panel]]
        axis.plot(x, [100 * row["real_time_factor"] for row in result["curves"][panel]], "o-", color="C0")
        axis.set(
            title=f"cost over {panel}" if x else f"cost over {panel}: not measured",
            xlabel=title,
            ylabel="% of one core",
            ylim=(0, None),
        )
        axis.grid(alpha=0.3)
    picture.save(figure, output)


def _draw_stages(axis: Axes, found: dict[str, dict]) -> None:
    """Mean ms of each stage, stacked, an engine a bar."""
    names = [name for name, row in found.items() if row["stages"]]
    bottom = np.zeros(len(names))
    for stage in max((found[name]["stages"] for name in names), key=len):
        parts = [found[name]["stages"].get(stage) for name in names]
        heights = [
            part["mean"] * part["hops"] / found[name]["hops"] if part else 0.0 for part, name in zip(parts, names)
        ]
        axis.bar(names, heights, bottom=bottom, label=stage)
        bottom += heights
    axis.bar(
        names, np.array([found[name]["mean"] for name in names]) - bottom, bottom=bottom, label="rest", color="0.8"
    )
    axis.set(title="what a paced hop is made of", ylabel="mean ms per hop")
    axis.legend(fontsize=8, loc="upper left")
