r"""Is the probability of speech one? The centre and slope that make it so, and what is noticed at which price.

    python -m bench.measure.barge_in_fit RECORDINGS --speech HUMAN/val --conversations VALIDATION/paper VALIDATION/live \
        --every 3 --output PATH                        (EDGEFILTER_CRNN=FILE.onnx for a network other than the package's)

Robots alone and humans laid on them (RECORDINGS, the tuning half, without a profile), and simulated conversations with
theirs, as they are and less the human. Of each hop: the averaged log-odds that `edgefilter/filter/barge_in.py` weighs, and whether the human sounds.
A logistic of both is fitted (Platt 1999), a human in one hop of four; the page says which CENTRE and SLOPE it has, how
far the probability is from the share of humans before and after, and for each threshold false starts an hour against
humans noticed. Where the fitted probability has --false-starts an hour the filter's usual threshold ought to be:
`export.onnx_export --platt SCALE BIAS` with the scale and bias of the page makes a network of which that is so.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit

from bench import results_writer
from bench.measure.closed_loop_scenes import listen
from bench.measure.conversation import every, find_conversations, progress
from bench.measure.levels import FRAME, frame_power
from bench.measure.real_barge_in import FIRST_DB, IN_TIME_S, THRESHOLDS, first_sound, in_time, noticed, replay, starts
from bench.measure.real_streams import ECHO_ONLY, ROBOT_ALONE, Cells, chosen, find_recordings, lay
from edgefilter.errors import EdgefilterError
from edgefilter.filter.barge_in import CENTRE, CENTRE_CALIBRATED, SLOPE, BargeInSettings
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Event, Samples

ENGINE = "crnn"
HUMAN_SHARE = 0.25
"""Share of hops with a human that the probability is to be right for."""
EDGES = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.0)
"""Of the probability, between the rows of the reliability table."""
SERS_DB = (0.0, -10.0, -20.0, -26.0)
AT_DB = -20.0
"""The laid humans of which the page says how many were noticed."""
AUDIBLE_DB = 20.0
"""Below the loudest sound: who begins with less, a breath say, is 40 dB below the robot where the whole is 20."""
SURE = 1e-9
FINE = tuple(round(0.5 + 0.01 * step, 2) for step in range(50))
"""Thresholds among which the one for so many false starts is looked for."""


class Listened(NamedTuple):
    """odds: averaged log-odds after each hop of so many samples; human: whether one sounds in it; ser: of a laid human, dB.

    audible: whether the human comes within AUDIBLE_DB of the loudest sound in time to be noticed.
    """

    kind: str
    odds: np.ndarray
    human: np.ndarray
    hop: int
    onset: int | None = None
    ser: float | None = None
    audible: bool = True


def listened(kind: str, mic: Samples, ref: Samples, human: Samples | None, profile: Profile | None) -> Listened:
    """What the network made of a recording, hop by hop."""
    talk = listen(mic, ref, profile, ENGINE)
    hop, centre = talk.hop, CENTRE if profile is None else CENTRE_CALIBRATED
    said = [probability or 0.0 for probability in talk.probability[: mic.size // hop]]
    odds = logit(np.clip(said, SURE, 1 - SURE)) / SLOPE + centre
    if human is None:
        return Listened(kind, odds, np.zeros(odds.size, bool), hop)
    power = frame_power(human[: odds.size * hop], hop)
    sounds = power > 10 ** (-FIRST_DB / 10) * power.max()
    onset = first_sound(human)
    return Listened(kind, odds, sounds, hop, onset, audible=audible(human, onset))


def audible(human: Samples, onset: int) -> bool:
    """Whether anything within AUDIBLE_DB of the human's loudest 20 ms sounds within IN_TIME_S of the onset."""
    power = frame_power(human)
    soon = power[onset // FRAME :][: round(IN_TIME_S * SAMPLE_RATE / FRAME)]
    return bool(soon.max() > 10 ** (-AUDIBLE_DB / 10) * power.max())


def streams(options: argparse.Namespace) -> Iterator[Listened]:
    """Everything that there is to listen to; robots alone with no human, and the others."""
    recordings = chosen(find_recordings(options.recordings, ROBOT_ALONE), "tune", "*")
    alone = [recording for recording in recordings if recording.kind == ECHO_ONLY]
    laid = lay(alone, options.speech, None, Cells(SERS_DB, (5.0,)), options.cases, options.seed)
    for recording in progress(alone, "alone"):
        signals = recording.signals()
        yield listened("real", signals.mic, signals.ref, None, None)
    for stream in progress(laid, "laid"):
        signals = stream.signals()
        human = np.zeros_like(signals.mic)
        human[signals.span] = signals.human[signals.span]
        yield listened("real", signals.mic, signals.ref, human, None)._replace(ser=stream.ser)
    sets = find_conversations(options.conversations) if options.conversations else {}
    for _, conversation in progress(every(sets, options.every), "conversation"):
        mic, ref, clean = (conversation.read(name) for name in ("mic", "ref", "clean"))
        yield listened("simulated", mic - clean, ref, None, conversation.profile)
        yield listened("simulated", mic, ref, clean, conversation.profile)


def pooled(chosen_ones: list[Listened]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Odds and truth of all hops (n,), and their weights, by which humans are HUMAN_SHARE of them."""
    odds, human = (np.concatenate([getattr(one, name) for one in chosen_ones]) for name in ("odds", "human"))
    share = float(np.clip(human.mean(), SURE, 1 - SURE))
    return odds, human, np.where(human, HUMAN_SHARE / share, (1 - HUMAN_SHARE) / (1 - share))


def fitted(chosen_ones: list[Listened]) -> tuple[float, float]:
    """Centre and slope of the logistic, by maximum likelihood, a human in HUMAN_SHARE of the hops."""
    odds, human, weight = pooled(chosen_ones)

    def cost(x: np.ndarray) -> float:
        z = np.exp(x[1]) * (odds - x[0])
        return float(np.mean(weight * (np.logaddexp(0.0, z) - human * z)))

    centre, log_slope = minimize(cost, np.array([CENTRE, np.log(SLOPE)]), method="Nelder-Mead").x
    return float(centre), float(np.exp(log_slope))


def sparing(chosen_ones: list[Listened], centre: float, slope: float, false_starts: float) -> float:
    """The lowest threshold on the fitted probability at which robots alone have at most so many false starts an hour."""
    alone = robots_alone(chosen_ones)
    few = (at for at in FINE if false_starts_an_hour(alone, centre, slope, at) <= false_starts)
    return next(few, FINE[-1])


def robots_alone(chosen_ones: list[Listened]) -> list[Listened]:
    """Those in whom nobody speaks."""
    return [one for one in chosen_ones if one.onset is None]


def false_starts_an_hour(alone: list[Listened], centre: float, slope: float, threshold: float) -> float:
    """At that threshold on the fitted probability."""
    hours = sum(one.odds.size * one.hop for one in alone) / SAMPLE_RATE / 3600
    return sum(starts(replayed(one, centre, slope, threshold)) for one in alone) / hours


def replayed(one: Listened, centre: float, slope: float, threshold: float) -> list[Event]:
    """What the filter would have said by the fitted probability."""
    return replay(expit(slope * (one.odds - centre)).tolist(), one.hop, threshold)


def platt(centre: float, slope: float, threshold: float, usual: float) -> dict[str, float]:
    """Scale and bias of the network's log-odds, by which the filter's threshold stands where this one does.

    The slope becomes the filter's as well. usual: the filter's centre.
    """
    scale = slope / SLOPE
    apart = float(logit(BargeInSettings().threshold) - logit(threshold)) / SLOPE
    return {"scale": scale, "bias": usual + apart - scale * centre}


def reliability(chosen_ones: list[Listened], centre: float, slope: float) -> dict:
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


def curve(chosen_ones: list[Listened], centre: float, slope: float) -> list[dict]:
    """For each threshold: false starts an hour on robots alone, and laid or conversing humans noticed in time."""
    alone, heard = robots_alone(chosen_ones), told(chosen_ones)
    points = []
    for threshold in THRESHOLDS:
        soon = [in_time(noticed(replayed(one, centre, slope, threshold), one.onset)) for one in heard]
        false = false_starts_an_hour(alone, centre, slope, threshold)
        points.append({"threshold": threshold, "an_hour": false, "noticed": float(np.mean(soon))})
    return points


def told(chosen_ones: list[Listened]) -> list[Listened]:
    """The humans of whom the curve says how many were noticed."""
    return [one for one in chosen_ones if one.onset is not None and one.ser in (None, AT_DB)]


def markdown(kinds: dict) -> str:
    """For each kind its fit, its reliability before and after, and its curve."""
    lines = [f"Of {ENGINE}'s network; a human in one hop of {1 / HUMAN_SHARE:.0f}.", ""]
    fits = [
        [
            name,
            *(f"{of[x]:.2f}" for x in ("centre", "slope", "threshold", "scale", "bias")),
            *(f"{of[x]['distance']:.3f}" for x in ("before", "after")),
        ]
        for name, of in kinds.items()
    ]
    lines += results_writer.table(
        ["", "centre", "slope", "threshold", "scale", "bias", "distance as it is", "distance fitted"], fits
    )
    for name, of in kinds.items():
        lines += ["", f"{name}, the probability and the share of hops with a human, as it is and fitted:", ""]
        lines += results_writer.table(["", "probability", "hops", "mean", "share"], _rows(of))
        lines += ["", f"{name}, by the threshold of the probability, as it is and fitted:", ""]
        found = zip(of["curve_before"], of["curve"], strict=True)
        cells = [
            [both[0]["threshold"], *(f"{x:.0f}" for each in both for x in (each["an_hour"], 100 * each["noticed"]))]
            for both in found
        ]
        columns = ["false starts an hour", f"noticed in {IN_TIME_S} s, %"]
        lines += results_writer.table(["threshold", *columns, *(f"fitted: {column}" for column in columns)], cells)
        first = f"in their first {IN_TIME_S} s they come within {AUDIBLE_DB:.0f} dB of their loudest sound"
        lines += ["", f"Of {of['humans']} humans {of['audible']} can be noticed so soon: {first}."]
    return "\n".join([*lines, ""])


def _rows(of: dict) -> list[list]:
    """Of the reliability table."""
    rows = []
    for name, when in (("before", "as it is"), ("after", "fitted")):
        for row in of[name]["rows"]:
            bounds = f"{row['low']:g} to {row['high']:g}"
            rows.append([when, bounds, row["hops"], f"{row['said']:.2f}", f"{row['share']:.2f}"])
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", type=Path, metavar="RECORDINGS")
    parser.add_argument("--speech", type=Path, required=True, metavar="DIR", help="humans to lay on them")
    parser.add_argument("--conversations", type=Path, nargs="*", default=[], metavar="DIR")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="N-th conversation only")
    parser.add_argument("--cases", type=int, default=12, help="humans laid at each level")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--false-starts", type=float, default=15.0, metavar="N", help="an hour that may be (default: 15)"
    )
    parser.add_argument("--output", type=Path, required=True, metavar="PATH")
    options = parser.parse_args()
    data = {"RECORDINGS": [options.recordings], "HUMAN": [options.speech], "conversations": options.conversations}
    try:
        made_with = results_writer.stamp(data, [ENGINE])
        found = list(streams(options))
    except (EdgefilterError, OSError) as error:
        print(f"barge_in_fit: {error}", file=sys.stderr)
        return 1
    kinds = {}
    for kind in dict.fromkeys(one.kind for one in found):
        own = [one for one in found if one.kind == kind]
        usual = CENTRE if kind == "real" else CENTRE_CALIBRATED
        centre, slope = fitted(own)
        before, after = reliability(own, usual, SLOPE), reliability(own, centre, slope)
        kinds[kind] = {"centre": centre, "slope": slope, "before": before, "after": after}
        kinds[kind] |= {"curve_before": curve(own, usual, SLOPE), "curve": curve(own, centre, slope)}
        kinds[kind]["threshold"] = sparing(own, centre, slope, options.false_starts)
        kinds[kind] |= platt(centre, slope, kinds[kind]["threshold"], usual)
        humans = told(own)
        kinds[kind] |= {"humans": len(humans), "audible": sum(one.audible for one in humans)}
    print(results_writer.write(options.output, made_with, "Probability of speech", markdown(kinds), {"kinds": kinds}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
