"""Is the probability of speech one? The centre and slope that make it so, and what is noticed at which price.

Robots alone and humans laid on them (--real, without a profile), and simulated conversations with theirs, as they are
and less the human. EDGEFILTER_CRNN=FILE.onnx names a network other than the package's. Of each hop: the
log-odds that edgefilter/filter/barge_in.py weighs, and whether the human sounds. A logistic of both is fitted (Platt
1999), a human in one hop of four; the page says which CENTRE and SLOPE it has, how far the probability is from the share
of humans before and after, and for each threshold false starts an hour against humans noticed. Where the fitted
probability has --false-starts an hour the filter's usual threshold ought to be: `export.onnx_export --platt SCALE BIAS`
with the scale and bias of the page makes a network of which that is so.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit

from bench import metrics, provenance, recordings, results, systems
from bench.metrics import FRAME, IN_TIME_S, THRESHOLDS
from bench.recordings import Cells, Signals, progress
from edgefilter.filter.barge_in import CENTRE, SLOPE, BargeInSettings
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Event, Samples

ENGINE = "crnn"
HUMAN_SHARE = 0.25
"""Share of hops with a human that the probability is to be right for."""
EDGES = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.0)
"""Of the probability, between the rows of the reliability table."""
AT_DB = -20.0
"""The laid humans of which the page says how many were noticed."""
AUDIBLE_DB = 20.0
"""Below the loudest sound: who begins with less, a breath say, is 40 dB below the robot where the whole is 20."""
SURE = 1e-9
FINE = tuple(round(0.5 + 0.01 * step, 2) for step in range(50))
"""Thresholds among which the one for so many false starts is looked for."""


class Listened(NamedTuple):
    """What was heard. odds: log-odds of each hop of so many samples; human: whether one sounds in it; ser: of a laid human, dB.

    audible: whether the human comes within AUDIBLE_DB of the loudest sound in time to be noticed.
    """

    kind: str
    odds: np.ndarray
    human: np.ndarray
    hop: int
    onset: int | None = None
    ser: float | None = None
    audible: bool = True


def listened(kind: str, signals: Signals, profile: Profile | None) -> Listened:
    """What the network made of a recording, hop by hop; nobody speaks where signals hold no human."""
    heard = systems.run_engine(systems.Row(ENGINE, profile is not None, False), signals, profile)
    said = np.array((heard.probability or [])[: signals.mic.size // heard.hop])
    odds = logit(np.clip(said, SURE, 1 - SURE)) / SLOPE + CENTRE
    if signals.human is None:
        return Listened(kind, odds, np.zeros(odds.size, bool), heard.hop)
    power = metrics.frame_power(signals.human[: odds.size * heard.hop], heard.hop)
    sounds = power > 10 ** (-metrics.FIRST_DB / 10) * power.max()
    onset = metrics.first_sound(signals.human)
    return Listened(kind, odds, sounds, heard.hop, onset, audible=audible(signals.human, onset))


def audible(human: Samples, onset: int) -> bool:
    """Whether anything within AUDIBLE_DB of the human's loudest 20 ms sounds within IN_TIME_S of the onset."""
    power = metrics.frame_power(human)
    soon = power[onset // FRAME :][: round(IN_TIME_S * SAMPLE_RATE / FRAME)]
    return bool(soon.max() > 10 ** (-AUDIBLE_DB / 10) * power.max())


def streams(options: argparse.Namespace) -> Iterator[Listened]:
    """Everything that there is to listen to; robots alone with no human, and the others."""
    for recording in progress(options.alone, "alone"):
        yield listened("real", recording.signals(), None)
    if options.alone:
        laid = recordings.lay(options.alone, options.speech, Cells(), options.cases, options.seed)
        for one in progress(laid, "laid"):
            yield listened("real", one.signals(), None)._replace(ser=one.ser)
    sets = recordings.find_conversations(options.conversations)
    for _, one in progress(recordings.every(sets, options.every, options.limit), "conversation"):
        yield listened("simulated", Signals(one.mic - one.human, one.ref), one.profile)
        yield listened("simulated", one.signals, one.profile)


def pooled(chosen_ones: Sequence[Listened]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Odds and truth of all hops (n,), and their weights, by which humans are HUMAN_SHARE of them."""
    odds, human = (np.concatenate([getattr(one, name) for one in chosen_ones]) for name in ("odds", "human"))
    share = float(np.clip(human.mean(), SURE, 1 - SURE))
    return odds, human, np.where(human, HUMAN_SHARE / share, (1 - HUMAN_SHARE) / (1 - share))


def fitted(chosen_ones: Sequence[Listened]) -> tuple[float, float]:
    """Centre and slope of the logistic, by maximum likelihood, a human in HUMAN_SHARE of the hops."""
    odds, human, weight = pooled(chosen_ones)

    def cost(x: np.ndarray) -> float:
        z = np.exp(x[1]) * (odds - x[0])
        return float(np.mean(weight * (np.logaddexp(0.0, z) - human * z)))

    centre, log_slope = minimize(cost, np.array([CENTRE, np.log(SLOPE)]), method="Nelder-Mead").x
    return float(centre), float(np.exp(log_slope))


def sparing(chosen_ones: Sequence[Listened], centre: float, slope: float, false_starts: float) -> float:
    """The lowest threshold on the fitted probability at which robots alone have at most so many false starts an hour."""
    few = (at for at in FINE if false_starts_an_hour(chosen_ones, centre, slope, at) <= false_starts)
    return next(few, FINE[-1])


def false_starts_an_hour(chosen_ones: Sequence[Listened], centre: float, slope: float, threshold: float) -> float:
    """Of those in whom nobody speaks, at that threshold on the fitted probability."""
    alone = [one for one in chosen_ones if one.onset is None]
    hours = sum(one.odds.size * one.hop for one in alone) / SAMPLE_RATE / 3600
    return sum(metrics.starts(replayed(one, centre, slope, threshold)) for one in alone) / hours


def replayed(one: Listened, centre: float, slope: float, threshold: float) -> list[Event]:
    """What the filter would have said by the fitted probability."""
    return metrics.replay(expit(slope * (one.odds - centre)).tolist(), one.hop, threshold)


def platt(centre: float, slope: float, threshold: float) -> dict[str, float]:
    """Scale and bias of the network's log-odds that put the filter's threshold here."""
    scale = slope / SLOPE
    apart = float(logit(BargeInSettings().threshold) - logit(threshold)) / SLOPE
    return {"scale": scale, "bias": CENTRE + apart - scale * centre}


def reliability(chosen_ones: Sequence[Listened], centre: float, slope: float) -> dict:
    """Share of hops with a human by the probability's value, and the mean distance of both (Guo et al. 2017, eq. (3))."""
    odds, human, weight = pooled(chosen_ones)
    said = expit(slope * (odds - centre))
    rows, far = [], 0.0
    for low, high in zip(EDGES, EDGES[1:], strict=False):
        here = (said >= low) & (said <= high if high == 1.0 else said < high)
        if here.any():
            mean, share = (float(np.average(x[here], weights=weight[here])) for x in (said, human))
            rows.append({"low": low, "high": high, "hops": int(here.sum()), "said": mean, "share": share})
            far += abs(mean - share) * weight[here].sum() / weight.sum()
    return {"rows": rows, "distance": far}


def curve(chosen_ones: Sequence[Listened], centre: float, slope: float) -> list[dict]:
    """For each threshold: false starts an hour of robots alone, and the share of humans, mixed in or in conversations, noticed in time."""
    points = []
    for threshold in THRESHOLDS:
        heard = ((one.onset, replayed(one, centre, slope, threshold)) for one in told(chosen_ones))
        soon = [metrics.in_time(metrics.noticed(events, onset)) for onset, events in heard]
        false = false_starts_an_hour(chosen_ones, centre, slope, threshold)
        points.append({"threshold": threshold, "an_hour": false, "noticed": float(np.mean(soon))})
    return points


def told(chosen_ones: Sequence[Listened]) -> list[Listened]:
    """The humans of whom the curve says how many were noticed."""
    return [one for one in chosen_ones if one.onset is not None and one.ser in (None, AT_DB)]


def tables(kinds: dict[str, dict]) -> list[dict]:
    """The fits of all kinds; for each its reliability and its curve, as it is and fitted."""
    keys = ("centre", "slope", "threshold", "scale", "bias")
    fits = [[name, *(of[key] for key in keys), *(of[when]["distance"] for when in ("before", "after"))]
            for name, of in kinds.items()]  # fmt: skip
    columns = ["", *((key, 2) for key in keys), ("distance as it is", 3), ("distance fitted", 3)]
    found = [results.table("fits", "Centre, slope, and the scale and bias for --platt", columns, fits)]
    for name, of in kinds.items():
        rows = [[when, f"{row['low']:g} to {row['high']:g}", row["hops"], row["said"], row["share"]]
                for key, when in (("before", "as it is"), ("after", "fitted")) for row in of[key]["rows"]]  # fmt: skip
        heads = ["", "probability", "hops", ("mean", 2), ("share of hops with a human", 2)]
        found.append(results.table(f"reliability-{name}", f"{name}: reliability", heads, rows))
        rows = [[at["threshold"], at["an_hour"], 100 * at["noticed"], fit["an_hour"], 100 * fit["noticed"]]
                for at, fit in zip(of["curve_before"], of["curve"], strict=True)]  # fmt: skip
        heads = [("threshold", 3)] + [(f"{when}{what}", 0) for when in ("", "fitted: ") for what in
                                      ("false starts an hour", f"noticed in {IN_TIME_S} s, %")]  # fmt: skip
        soon = f"in their first {IN_TIME_S} s they come within {AUDIBLE_DB:.0f} dB of their loudest sound"
        text = f"Of {of['humans']} humans {of['audible']} can be noticed so soon: {soon}."
        found.append(results.table(f"curve-{name}", f"{name}: by threshold of the probability", heads, rows, text))
    return found


def run(options: argparse.Namespace) -> str:
    data = {"RECORDINGS": [options.real] if options.real else [], "conversations": options.conversations}
    data["HUMAN"] = [options.speech] if options.speech else []
    made_with = provenance.stamp(data, ["crnn", "crnn-uncalibrated"])
    found, kinds = list(streams(options)), {}
    for kind in dict.fromkeys(one.kind for one in found):
        own = [one for one in found if one.kind == kind]
        centre, slope = fitted(own)
        before, after = reliability(own, CENTRE, SLOPE), reliability(own, centre, slope)
        kinds[kind] = {"centre": centre, "slope": slope, "before": before, "after": after}
        kinds[kind] |= {"curve_before": curve(own, CENTRE, SLOPE), "curve": curve(own, centre, slope)}
        kinds[kind]["threshold"] = sparing(own, centre, slope, options.false_starts)
        kinds[kind] |= platt(centre, slope, kinds[kind]["threshold"])
        humans = told(own)
        kinds[kind] |= {"humans": len(humans), "audible": sum(one.audible for one in humans)}
    notes = f"Of {ENGINE}'s network; a human in one hop of {1 / HUMAN_SHARE:.0f}."
    return results.write(options.output, "probability", "Probability of speech", made_with, tables(kinds), [diagram(kinds)],
                         notes, kinds=kinds)  # fmt: skip


def diagram(kinds: dict[str, dict]) -> dict:
    """The reliability diagram: for each kind the share of hops with a human over the probability, and what is right."""
    lines = {
        name: tuple([row[key] for row in of["before"]["rows"]] for key in ("said", "share"))
        for name, of in kinds.items()
    }
    lines["right"] = EDGES, EDGES
    return results.plot(
        "reliability", [results.panel("Reliability", "probability", "share of hops with a human", lines, "o-")]
    )
