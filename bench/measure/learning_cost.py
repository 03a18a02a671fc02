"""What a hop costs with a learner in another process and without, in turns, and what that process takes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench import results_writer
from bench.measure import picture
from bench.measure.conversation import progress
from bench.measure.intervals import percentiles
from bench.measure.latency import CORES, figures, run_hops

WAYS = {"alone": "#888888", "learning": "#b3412b"}
SHOWN = ("50", "95", "99", "100")


def measure(engines: list[str], seconds: float, rounds: int) -> dict:
    """Rows by engine, ready for JSON; every other round is in reversed order."""
    turns = [(engine, way) for engine in engines for way in WAYS]
    runs: dict[tuple[str, str], list[dict]] = {turn: [] for turn in turns}
    for number in progress(range(rounds), "round"):
        for engine, way in reversed(turns) if number % 2 else turns:
            runs[engine, way].append(run_hops(engine, seconds, paced=True, learning=way == "learning"))
    rows = [row({way: runs[engine, way] for way in WAYS}, seconds) for engine in engines]
    return {
        "seconds": seconds,
        "rounds": rounds,
        "rows": [{"engine": engine, **found} for engine, found in zip(engines, rows, strict=True)],
    }


def row(runs: dict[str, list[dict]], seconds: float) -> dict:
    """Figures of one engine: of the hops of all rounds together, of each round's p99, and of the other process."""
    hops = {way: figures(np.concatenate([run["took"] for run in of]), of[0]["hop"]) for way, of in runs.items()}
    p99s = {way: [percentiles(run["took"], 99)["p99"] for run in of] for way, of in runs.items()}
    learned = [run["learned"] for run in runs["learning"]]
    return {
        "hops": hops,
        "p99_ratio": hops["learning"]["quantiles"]["99"] / hops["alone"]["quantiles"]["99"],
        "p99_ratios": [after / before for before, after in zip(p99s["alone"], p99s["learning"], strict=True)],
        "cpu_s_per_minute": [60 * of["cpu_s"] / seconds for of in learned],
        "memory_mb": [of["memory_mb"] for of in learned],
        "learned": learned,
    }


def draw(found: dict, output: Path) -> None:
    """Milliseconds per hop over percentiles."""
    figure, axes = picture.panels(1, len(found["rows"]), (5 * len(found["rows"]), 4))
    for axis, of in zip(axes, found["rows"], strict=True):
        for way, colour in WAYS.items():
            quantiles = of["hops"][way]["quantiles"]
            axis.plot(range(len(quantiles)), list(quantiles.values()), "o-", color=colour, label=way)
        axis.set_xticks(range(len(quantiles)), list(quantiles), rotation=60)
        axis.set(xlabel="percentile of the hops", ylabel="ms", yscale="log", title=of["engine"])
        axis.grid(alpha=0.3)
        axis.legend()
    picture.save(figure, output)


def markdown(found: dict, name: str) -> str:
    """Hops, and the learner's process. name: of the picture, without suffix."""
    lines = [
        f"{found['rounds']} rounds of {found['seconds']:.0f} s at the real pace for each row, in turns, the order reversed every other",
        f"round; each a process of its own with its learner's, both on the same {CORES} cores. The bundled conversation over and",
        "over, with its profile; a hop is 16 ms. Milliseconds per hop of all rounds together:",
        "",
    ]
    cells = [
        [
            of["engine"],
            way,
            *(f"{of['hops'][way]['quantiles'][percent]:.2f}" for percent in SHOWN),
            of["hops"][way]["missed"],
        ]
        for of in found["rows"]
        for way in WAYS
    ]
    lines += results_writer.table(["engine", "", "p50", "p95", "p99", "max", "hops over 16 ms"], cells)
    lines += ["", "What learning does to the p99, and what its process takes (its start included):", ""]
    cells = [
        [
            of["engine"],
            f"{of['p99_ratio']:.2f} ({min(of['p99_ratios']):.2f} to {max(of['p99_ratios']):.2f})",
            f"{np.mean(of['cpu_s_per_minute']):.1f}",
            f"{max(of['memory_mb']):.0f}",
            f"{np.mean([learned['rounds'] for learned in of['learned']]):.1f}",
            sum(learned["fell_behind"] for learned in of["learned"]),
        ]
        for of in found["rows"]
    ]
    columns = ["engine", "p99 with over without (least and most of a round)", "CPU, s a minute", "memory, MB"]
    lines += results_writer.table([*columns, "fits a round", "times it fell behind"], cells)
    return "\n".join([*lines, "", f"![milliseconds per hop]({name}.png)", ""])
