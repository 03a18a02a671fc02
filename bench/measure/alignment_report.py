"""The page and the picture of alignment.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.measure import picture
from bench.simulate.alignment_scene import RATE

HOP = 256
CLOSE = 16
"""Samples within which a lag is found, 1 ms."""
JUMPS = (2, 3, 5, 8, 16, 40, 100, 250, 500, 1500)
REACH = 960
"""Jumps beyond this need a search of all lags."""


def markdown(result: dict) -> str:
    """The page below its head."""
    lines = [f"Simulated rooms (RT60 0.2-0.75 s), voices and speech from recordings; seed {result['seed']}.\n",
             "| | within 1 ms at 300 ms | ever | time to align p50 / p95, ms | final error p50 / p95, samples |",
             "| --- | --- | --- | --- | --- |"]  # fmt: skip
    for name, block in result["lags"].items():
        rows = block["rows"]
        at = np.mean([r["error_300ms"] is not None and abs(r["error_300ms"]) < CLOSE for r in rows])
        times = [r["time_ms"] if r["time_ms"] is not None else 9999.0 for r in rows]
        final = np.abs(np.array([r["final_error"] for r in rows], float))  # null in a file that was read is no number
        ever = np.mean([r["time_ms"] is not None for r in rows])
        t50, t95 = np.percentile(times, [50, 95])
        f50, f95 = np.nanpercentile(final, [50, 95])
        lines.append(
            f"| {name}, {len(rows)} utterances | {100 * at:.1f} % | {100 * ever:.1f} % | {t50:.0f} / {t95:.0f} "
            f"| {f50:.2f} / {f95:.2f} |"
        )
    for name, block in result["lags"].items():
        d = np.array(block["drift"])
        at = {s: d[:, min(int(s * RATE / HOP), d.shape[1] - 1)] for s in (1, 2, 5)}
        lines.append(
            f"\nDrift error ({name}), median / p95 ppm after the first lock: "
            + ", ".join(f"{s} s {v[0]:.1f} / {v[1]:.1f}" for s, v in at.items())
        )
    for name, inside in (
        (f"of 2 to {JUMPS[-2]} samples", True),
        (f"of {JUMPS[-1]} samples, beyond the tracker's reach", False),
    ):
        jumps = [r for r in result["jumps"] if (abs(r["jump"]) < REACH) == inside]
        p50, p95, worst = np.percentile([r["ms_of_speech"] for r in jumps], [50, 95, 100])
        within = np.mean([r["healed"] and r["ms_of_speech"] <= 200 for r in jumps])
        lines.append(
            f"\n{len(jumps)} jumps {name}: healed (to 0.7 samples) after p50 {p50:.0f}, p95 {p95:.0f}, "
            f"max {worst:.0f} ms of speech; {100 * within:.0f} % within 200 ms."
        )
    lines.append(
        f"\nFalse realignments in {result['false_minutes']} minutes each: "
        + ", ".join(f"{k}: {v}" for k, v in result["false"].items())
    )
    for name, figures in result["long"]["parts"].items():
        r = {key: np.nan if value is None else value for key, value in figures.items()}
        lines.append(
            f"\n{result['long_minutes']} minutes at 100 ppm, {name}: jitter {r['rms_jitter']:.4f} samples rms, "
            f"mean {r['mean_error']:+.3f}, at most {r['worst_error']:.3f} from it, "
            f"drift error {r['rms_ppm_error']:.2f} ppm rms"
        )
    cost = result["cost"]
    busy = (
        f" (beside {cost['others']} running processes: not to be quoted)"
        if cost["others"]
        else " (nothing else running)"
    )
    lines.append(
        f"\nRealignments in it: {result['long']['realigned']} (1 is the first lock)\n\n"
        f"Cost per hop of {HOP}, ms{busy}: " + ", ".join(f"{k} {v:.3f}" for k, v in cost["ms"].items())
    )
    return "\n".join(lines) + "\n"


def draw(result: dict, output: Path) -> None:
    """Distributions of lag error, time to align and drift; jumps; the long run."""
    figure, (a, b, c, d, e, f) = picture.panels(2, 3, (15, 8))
    for name, block in result["lags"].items():
        error = np.sort([abs(r["error_300ms"]) if r["error_300ms"] is not None else 1e5 for r in block["rows"]])
        share = (np.arange(error.size) + 1) / error.size
        a.semilogx(np.maximum(error, 1e-3), share, label=name)
        times = np.sort([r["time_ms"] if r["time_ms"] is not None else 1e4 for r in block["rows"]])
        b.plot(np.minimum(times, 1000), share, label=name)
        seconds = np.arange(len(block["drift"][0])) * HOP / RATE
        c.semilogy(seconds, block["drift"][0], label=f"{name}, median")
        c.semilogy(seconds, block["drift"][1], "--", label=f"{name}, 95 %")
    a.axvline(CLOSE, color="k", lw=0.5)
    b.axvline(300, color="k", lw=0.5)
    a.set(title="Lag error 300 ms after the onset", xlabel="samples", ylabel="share of utterances")
    b.set(title="Time to align (within 1 ms, to stay)", xlabel="ms", ylabel="share of utterances")
    c.set(title="Drift error", xlabel="s after first lock", ylabel="ppm")
    d.semilogx([abs(r["jump"]) for r in result["jumps"]], [r["ms_of_speech"] for r in result["jumps"]], "o", alpha=0.6)
    d.axhline(200, color="k", lw=0.5)
    d.set(title="Jump healed after", xlabel="jump, samples", ylabel="ms of robot speech")
    error, ppm_error = (np.array(result["long"][key], float) for key in ("error", "ppm_error"))
    e.plot(np.linspace(0, result["long_minutes"], error.size), error, lw=0.7)
    e.set(title="Delay error in long speech, 100 ppm", xlabel="minutes", ylabel="samples", ylim=(-0.5, 0.5))
    f.plot(np.linspace(0, result["long_minutes"], error.size), ppm_error, lw=0.7)
    f.set(title="Drift error in long speech", xlabel="minutes", ylabel="ppm", ylim=(-2, 2))
    for axis in (a, b, c):
        axis.legend(fontsize=8)
    picture.save(figure, output, dpi=90)
