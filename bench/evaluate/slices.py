"""Where systems fail: the clips cut by one quantity at a time, and the source paper's three conclusions put to the test."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.evaluate.facts import QUANTITIES, Quantity
from bench.evaluate.figures import Group, Results
from bench.evaluate.systems import BATCH_NORM, NARROW_BATCH_NORM
from bench.measure.intervals import RESAMPLES

PARTS = 3
"""A quantity is cut into so many slices of about as many clips each."""
CUT = ("unfiltered", "paper-ss", "linear", "ss", "crnn", "crnn-uncalibrated", "speexdsp-suppressed", "aec3", "dtln")
"""Systems that the slices show, where they ran; and the best one, where it is another."""
PAPER = "Li, Hindriks & Kunneman 2024"
FEW = 8
"""With fewer clips nothing is said of a conclusion."""
NORMED = {NARROW_BATCH_NORM: "paper-crnn-narrow", f"crnn:{BATCH_NORM}": "crnn"}
"""Networks with batch normalisation, and the row each is compared with."""


def whole(results: Results) -> Group:
    """All clips in which a human's words are known."""
    members = tuple(index for index, clip in enumerate(results.clips) if clip.text is not None)
    return Group(results, "all", "", members)


def metric_of(results: Results) -> str:
    """By what it is cut: capped WER, or SI-SDR without a recogniser."""
    return "capped" if results.recognisers else "si_sdr"


def shown(results: Results) -> list[str]:
    """The systems of CUT that ran, and the best."""
    ran = [system.name for system in results.systems]
    best = whole(results).best(metric_of(results))
    return [name for name in ran if name in CUT or name == best]


def slices(results: Results) -> list[dict]:
    """Of each quantity the slices, each with its clips and of each shown system the mean and interval."""
    found = []
    for quantity in QUANTITIES:
        parts = cut(results, quantity)
        if len(parts) > 1:
            rows = [
                {"slice": name, "clips": len(part.members), "systems": _means(part, results)} for name, part in parts
            ]
            found.append({"key": quantity.key, "title": quantity.title, "unit": quantity.unit, "rows": rows})
    return found


def _means(part: Group, results: Results) -> dict[str, dict | None]:
    return {name: part.mean(name, metric_of(results)) for name in shown(results)}


def cut(results: Results, quantity: Quantity) -> list[tuple[str, Group]]:
    """The clips by this quantity: each word by itself, numbers in PARTS of about as many clips each."""
    every = whole(results)
    known = [(index, results.rows[index]["facts"].get(quantity.key)) for index in every.members]
    known = [(index, value) for index, value in known if value is not None]
    if any(isinstance(value, str) for _, value in known):
        names = sorted({str(value) for _, value in known})
        return [(name, every.part([index for index, value in known if value == name])) for name in names]
    values = np.array([value for _, value in known], np.float64)
    edges = np.unique(np.quantile(values, np.linspace(0, 1, PARTS + 1))) if values.size else values
    found = []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        last = high == edges[-1]
        inside = [index for index, value in known if low <= float(value) and (value < high or last)]
        if inside:
            name = f"{low:.{quantity.digits}f} to {high:.{quantity.digits}f}"
            found.append((name, every.part(inside)))
    return found


def conclusions(results: Results) -> list[dict]:
    """What the paper concluded, and whether these recordings say so as well: title, verdict, and in what figures."""
    return [_volume_and_pitch(results), _reverberation(results), _batch_norm(results)]


def _volume_and_pitch(results: Results) -> dict:
    title = "A loud or high-pitched human is understood better"
    words, signs = [], []
    for key, name in (("level_db", "level"), ("pitch_hz", "pitch")):
        for system in ("paper-ss", "crnn"):
            found = correlation(results, key, system)
            if found:
                words.append(f"{name} and {system}: {found[0]:+.2f} [{found[1]:+.2f}, {found[2]:+.2f}]")
                signs.append(_sign(-found[1], -found[2]) if metric_of(results) == "capped" else _sign(*found[1:]))
    measure = "capped word error" if metric_of(results) == "capped" else "SI-SDR"
    return _conclusion(title, signs, f"Rank correlation with the {measure}: {'; '.join(words)}." if words else "")


def _reverberation(results: Results) -> dict:
    """By how much more the office costs paper-ss than the network: in words, and in dB, which end at no 100 %."""
    title = "Spectral subtraction suffers from reverberation, the network less"
    network = next((name for name in ("paper-crnn", "crnn") if _ran(results, name)), "")
    rooms = {room: _in_room(results, room) for room in ("lab", "office")}
    if not network or not _ran(results, "paper-ss") or min(len(group.members) for group in rooms.values()) < FEW // 2:
        return _conclusion(title, [], "")
    signs, told = [], []
    for metric, worse, unit in _measures(results):
        draws = {
            (name, room): _draws(results, rooms[room], name, metric) for name in ("paper-ss", network) for room in rooms
        }
        rises = {name: draws[name, "office"] - draws[name, "lab"] for name in ("paper-ss", network)}
        signs.append(_sign(*np.nanpercentile(worse * (rises["paper-ss"] - rises[network]), [2.5, 97.5])))
        each = [f"{name} {_middle(rise)} from {np.nanmedian(draws[name, 'lab']):.1f}" for name, rise in rises.items()]
        told.append(f"{unit}: {', '.join(each)}")
    return _conclusion(title, signs, f"From the laboratory to the office, {'; '.join(told)}.")


def _measures(results: Results) -> list[tuple[str, int, str]]:
    """By what a conclusion is judged: words where there is a recogniser, and dB; 1 where more is worse, else -1; the unit."""
    words = [("capped", 1, "points of capped WER")] if results.recognisers else []
    return [*words, ("si_sdr", -1, "dB of SI-SDR")]


def _batch_norm(results: Results) -> dict:
    """In words, and in dB, which end at no 100 %; contradicted only where it does help."""
    title = "Batch normalisation does not help"
    signs, told = [], []
    for metric, worse, unit in _measures(results):
        for normed, without in NORMED.items():
            ran = _ran(results, normed) and _ran(results, without)
            found = whole(results).difference(normed, without, metric) if ran else None
            if found and found["count"] >= FEW:
                signs.append(1 if max(worse * found["low"], worse * found["high"]) >= 0 else -1)
                told.append(f"{without} {found['difference']:+.1f} [{found['low']:+.1f}, {found['high']:+.1f}] {unit}")
    lacks = f"needs {NARROW_BATCH_NORM}, or --network {BATCH_NORM}=FILE.onnx, a network trained with it"
    return _conclusion(title, signs, f"With it less without: {'; '.join(told)}.", lacks)


def correlation(results: Results, key: str, system: str) -> tuple[float, float, float] | None:
    """Spearman's rank correlation of a quantity with the figure of a system, and its interval; None with FEW clips.

    Ranks are within a set and room, so that what differs between rooms is not taken for the quantity.
    """
    x, y, members = [], [], []
    for group in results.groups:
        known = group.part([at for at in group.members if key in results.rows[at]["facts"]])
        inside, values = known.column(system, metric_of(results))
        if len(inside) > 1:
            quantity = np.array([float(results.rows[at]["facts"][key]) for at in inside])
            x.append(_ranks(quantity) / len(inside))
            y.append(_ranks(values) / len(inside))
            members += inside
    if len(members) < FEW:
        return None
    ranks = np.concatenate(x), np.concatenate(y)
    low, high = np.nanpercentile(_correlation(whole(results).weights(members), *ranks), [2.5, 97.5])
    return float(_correlation(np.ones((1, len(members))), *ranks)[0]), float(low), float(high)


def _correlation(weights: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    total = np.maximum(weights.sum(axis=1), 1e-9)
    mean_x, mean_y = weights @ x / total, weights @ y / total
    shared = weights @ (x * y) / total - mean_x * mean_y
    spread = (weights @ x**2 / total - mean_x**2) * (weights @ y**2 / total - mean_y**2)
    return np.where(spread > 1e-9, shared / np.sqrt(np.maximum(spread, 1e-9)), np.nan)


def _ranks(values: np.ndarray) -> np.ndarray:
    """From 0, ties at their middle."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - (counts + 1) / 2)[inverse]


def _draws(results: Results, part: Group, system: str, metric: str) -> np.ndarray:
    """The mean over a part of the clips in each draw of clusters, (RESAMPLES,); speakers of both parts are drawn for both."""
    every = whole(results)
    members, values = part.column(system, metric)
    if not members:
        return np.full(RESAMPLES, np.nan)
    weights = every.weights(every.members)[:, [every.members.index(member) for member in members]]
    sums = weights.sum(axis=1)
    return np.where(sums > 0, weights @ values / np.maximum(sums, 1e-9), np.nan)


def _in_room(results: Results, room: str) -> Group:
    every = whole(results)
    return every.part([index for index in every.members if results.clips[index].room == room])


def _ran(results: Results, name: str) -> bool:
    return any(system.name == name for system in results.systems)


def _sign(low: float, high: float) -> int:
    low, high = sorted((low, high))
    return 1 if low > 0 else -1 if high < 0 else 0


def _middle(draws: np.ndarray) -> str:
    low, middle, high = np.nanpercentile(draws, [2.5, 50, 97.5])
    return f"{middle:+.1f} [{low:+.1f}, {high:+.1f}]"


def _conclusion(title: str, signs: Sequence[int], text: str, lacks: str = "too few clips or systems") -> dict:
    """Its verdict: as concluded where every sign is for it, contradicted where every one is against it."""
    if not signs:
        verdict = f"not tested: {lacks}"
    elif all(sign > 0 for sign in signs):
        verdict = "seen here as well"
    elif all(sign < 0 for sign in signs):
        verdict = "the opposite is seen here"
    else:
        verdict = "partly seen here" if any(sign > 0 for sign in signs) else "not seen here"
    return {"conclusion": title, "verdict": verdict, "figures": text}
