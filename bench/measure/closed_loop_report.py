"""The tables and the curve of bench.measure.closed_loop."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from bench.measure import picture
from bench.measure.closed_loop_scenes import HOLDS_S
from bench.measure.intervals import interval, wilson
from bench.measure.real_barge_in import IN_TIME_S, THRESHOLDS
from bench.results_writer import table

POLICIES = {
    "muted": "microphone muted while the robot speaks",
    "open": "open loop: the robot talks on",
    "duck": "closed loop: 10 dB lower from the event on",
    "stop": "closed loop: stopped by the event",
    "oracle": "oracle: silent at the human's first sound",
    "alone": "the human alone, no fan, no robot",
}
SHORT = {"word": "a word of 0.3-0.5 s", "cough": "a cough"}
DEFAULT = THRESHOLDS.index(0.97)


def summarise(rows: list[dict], alone: list[dict]) -> dict:
    """Figures ready for JSON: noticed, words, short, false stops, the curve over the threshold."""
    found: dict = {"noticed": {start: noticing([row[start] for row in rows]) for start in ("calibrated", "cold")}}
    if rows and "heard" in rows[0]:
        found["words"] = {name: word_rates([row["heard"][name] for row in rows]) for name in POLICIES}
    long = [row["calibrated"] for row in rows]
    found["lasts"] = {"interruption": lasting(long)}
    found["lasts"] |= {kind: lasting([row["short"][kind] for row in rows]) for kind in SHORT}
    groups = {
        f"{of}, {start}": (of, start) for of in ("moderate", "strong", "real") for start in ("calibrated", "cold")
    }
    parts = {name: [r for r in alone if (r["distortion"], r["start"]) == of] for name, of in groups.items()}
    made_by = sorted({synthesiser(row) for row in alone})
    parts |= {f"of these {name}": [row for row in alone if synthesiser(row) == name] for name in made_by}
    parts["all"] = alone
    found["false_stops"] = {name: false_stops(part) for name, part in parts.items() if part}
    simulated = [row for row in alone if row["source"] == "simulated"]
    found["curve"] = {start: curve([r[start] for r in rows], simulated, start) for start in ("calibrated", "cold")}
    return found


def synthesiser(row: dict) -> str:
    """What made the robot's voice: the name before the first hyphen, of Kokoro's voices there is none."""
    if row["source"] == "real":
        return "real"
    maker, hyphen, _ = row["voice"].partition("-")
    return maker if hyphen else "neural"


def noticing(judged: Sequence[dict]) -> dict:
    """Of the interruptions: how many in time, the delays, how many early (speech was on already) or never noticed."""
    delays = [np.inf if one["delay_s"] is None else one["delay_s"] for one in judged if not one["early"]]
    p50, p90 = (np.quantile(delays, q, method="higher") if delays else np.nan for q in (0.5, 0.9))
    in_time = sum(one["in_time"] for one in judged)
    counts = {"n": len(judged), "in_time": in_time, "interval": wilson(in_time, len(judged))}
    return {
        **counts,
        "p50_s": p50,
        "p90_s": p90,
        "early": len(judged) - len(delays),
        "never": int(np.isinf(delays).sum()),
    }


def word_rates(heard: Sequence[dict]) -> dict:
    """Word errors in %: means of the utterances' rates, each at most 100 %, with intervals; the number of words."""
    found: dict = {"utterances": len(heard)}
    for name, prefix in (("whole", ""), ("first", "first_")):
        rates = [100 * min(1.0, one[f"{prefix}errors"] / one[f"{prefix}words"]) for one in heard]
        found[name] = float(np.mean(rates))
        found[f"{name}_interval"] = interval(lambda x: x.mean(axis=1), rates)
        found[f"{name}_words"] = sum(one[f"{prefix}words"] for one in heard)
    return found


def lasting(judged: Sequence[dict]) -> dict:
    """How many began an event at all, in time, and are still on after each of HOLDS_S."""
    begun = [one["lasts"] for one in judged if one["lasts"] is not None]
    still = [sum(one[i] for one in begun) for i in range(len(HOLDS_S))]
    return {"n": len(judged), "begun": len(begun), "in_time": sum(one["in_time"] for one in judged), "still": still}


def false_stops(rows: Sequence[dict]) -> dict:
    """Per hour of robot speech with the exact Poisson interval (95 %), and what was heard: distinct minutes, voices."""
    hours, count = sum(row["speech_s"] for row in rows) / 3600, sum(row["stops"] for row in rows)
    clips = {name: seconds for row in rows for name, seconds in row["said"]}
    low, high = stats.chi2.ppf([0.025, 0.975], [2 * count or 1, 2 * count + 2]) / 2 / hours
    return {
        "robots": len(rows),
        "minutes": 60 * hours,
        "distinct_minutes": sum(clips.values()) / 60,
        "voices": len({row["voice"] for row in rows}),
        "stops": count,
        "per_hour": count / hours,
        "interval": (float(low) if count else 0.0, float(high)),
    }


def curve(judged: Sequence[dict], alone: Sequence[dict], start: str) -> list[dict]:
    """A point for each of THRESHOLDS."""
    own = [row for row in alone if row["start"] == start]
    hours = sum(row["speech_s"] for row in own) / 3600
    stops = np.sum([row["stops_at"] for row in own], axis=0) / hours if own else np.full(len(THRESHOLDS), np.nan)
    in_time = np.mean([one["in_time_at"] for one in judged], axis=0)
    return [
        {"threshold": at, "in_time": share, "stops_per_hour": rate, "hours": hours}
        for at, share, rate in zip(THRESHOLDS, in_time, stops, strict=True)
    ]


def markdown(content: dict, image: str) -> str:
    """The page behind its head."""
    found = content["summary"]
    lines = [f"Engine `{content['engine']}`, default threshold. Humans 20-28 dB below the robot that talks meanwhile."]
    lines += ["", "## Interruptions noticed", ""]
    columns = ["filter", "n", f"within {IN_TIME_S} s", "95 %", "p50 / p90", "speech was on already", "never"]
    cells = []
    for start, of in found["noticed"].items():
        low, high = of["interval"]
        share = f"{100 * of['in_time'] / of['n']:.0f} %"
        delays = " / ".join("never" if np.isinf(of[p]) else f"{of[p]:.2f} s" for p in ("p50_s", "p90_s"))
        cells.append([start, of["n"], share, f"{100 * low:.0f}-{100 * high:.0f} %", delays, of["early"], of["never"]])
    lines += table(columns, cells)
    lines += [*heard(found), *lasts(found), *alarms(found), "", "## Curve", "", f"![curve]({image})", ""]
    columns = ["threshold", "calibrated: in time, %", "false stops an hour", "cold: in time, %", "false stops an hour"]
    pairs = zip(found["curve"]["calibrated"], found["curve"]["cold"], strict=True)
    cells = [
        [a["threshold"]]
        + [x for p in (a, b) for x in (f"{100 * p['in_time']:.0f}", f"{p['stops_per_hour']:.1f}" if p["hours"] else "")]
        for a, b in pairs
    ]
    return "\n".join([*lines, *table(columns, cells)]) + "\n"


def heard(found: dict) -> list[str]:
    """What the recogniser makes of the interruption."""
    if "words" not in found:
        return []
    first = next(iter(found["words"].values()))
    lines = ["", "## Word errors of the interruption, calibrated", ""]
    lines += [
        f"Whisper-base, {first['utterances']} interruptions, {first['whole_words']} words; mean of the utterances' rates,"
        " each at most 100 %, with a 95 % bootstrap",
        f"interval. First second: the {first['first_words']} words that lie in it going by their letters.",
        "",
    ]
    cells = []
    for name, text in POLICIES.items():
        of = found["words"][name]
        figures = [
            f"{of[part]:.0f} [{of[f'{part}_interval'][0]:.0f}, {of[f'{part}_interval'][1]:.0f}]"
            for part in ("whole", "first")
        ]
        cells.append([text, *figures])
    return lines + table(["", "whole, %", "first second, %"], cells)


def lasts(found: dict) -> list[str]:
    """Backchannels beside interruptions: what is noticed, and what is still on after a while."""
    lines = [
        "",
        "## Backchannels",
        "",
        "Open loop, calibrated, speech ended by 0.2 s of silence. The words are cut from the",
    ]
    lines += ["humans' first syllables, the coughs are bursts of noise: stand-ins, not recordings of either.", ""]
    columns = ["", "n", "an event", f"within {IN_TIME_S} s", *(f"still on {s} s later" for s in HOLDS_S)]
    names = {"interruption": "an interruption", **SHORT}
    cells = [[names[k], of["n"], of["begun"], of["in_time"], *of["still"]] for k, of in found["lasts"].items()]
    return lines + table(columns, cells)


def alarms(found: dict) -> list[str]:
    """The robot alone."""
    lines = ["", "## False stops", ""]
    columns = ["loudspeaker, filter", "robots", "minutes of speech", "distinct", "voices", "stops", "an hour", "95 %"]
    cells = []
    for name, of in found["false_stops"].items():
        low, high = of["interval"]
        spoken = [f"{of['minutes']:.1f}", f"{of['distinct_minutes']:.1f}", of["voices"]]
        cells.append([name, of["robots"], *spoken, of["stops"], f"{of['per_hour']:.1f}", f"{low:.1f}-{high:.1f}"])
    return lines + table(columns, cells)


def draw(curves: dict, output: Path) -> None:
    """Part of the interruptions that is noticed in time over false stops an hour, threshold by threshold."""
    figure, (axis,) = picture.panels(1, 1, (6, 4.5))
    for start, points in curves.items():
        rates = [point["stops_per_hour"] for point in points]
        shares = [100 * point["in_time"] for point in points]
        axis.plot(rates, shares, marker="o", label=f"{start}, {points[0]['hours']:.2f} h of robot speech")
        axis.plot(rates[DEFAULT], shares[DEFAULT], marker="o", markersize=11, color="black", fillstyle="none")
    axis.set(xlabel="false stops an hour of robot speech", ylabel=f"noticed within {IN_TIME_S} s, %", ylim=(0, 102))
    axis.set_xscale("symlog", linthresh=1.0)
    axis.set_xlim(left=-0.1)
    axis.set_title("threshold 0.5 to 0.995, the default circled", fontsize=10)
    axis.grid(alpha=0.3)
    axis.legend(loc="lower right")
    picture.save(figure, output)
