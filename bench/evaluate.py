r"""Every system on every recording: words, SI-SDR, what was lost and what is left, and where it fails.

    python -m bench evaluate FOLDER [FOLDER ...] --speech HUMAN --whisper WHISPER --output PATH

Below each FOLDER: conversations as bench.simulate.conversations makes them, and pairs NAME_lpb and NAME_mic of real
devices. Humans of --speech are laid on the robot alone of the devices that match --laid-on, on the half of their
recordings that is kept to report on. Scores are kept: a run that was cut off goes on, and a new row computes nothing but
itself. The same seed gives the same figures, computing times excepted.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
from scipy.stats import rankdata

from bench import metrics, provenance, recordings, results, runner, systems
from bench.metrics import QUANTITIES, SECOND, difference, mean, middle, pooled
from bench.recordings import Cells, Clip
from bench.systems import System
from edgefilter.errors import UsageError

HEADLINE = ("unfiltered", "speexdsp-suppressed", "linear-uncalibrated", "linear-uncalibrated-learning",
            "crnn-uncalibrated-learning", "crnn", "crnn-learning")  # fmt: skip
"""Rows of the table that docs/index.md quotes."""
PAIRED = "crnn-uncalibrated-learning"
"""The baseline of that table: each other row is compared with it on the same clips. It needs no calibration, so every clip has it."""
CUT = ("unfiltered", "paper-ss", "linear", "ss", "crnn", "crnn-learning", "crnn-uncalibrated", "speexdsp-suppressed",
       "aec3")  # fmt: skip
"""Rows that the slices show, where they ran."""
PARTS = 3
"""A quantity is cut into so many slices of about as many clips each."""
FEW = 8
"""With fewer clips nothing is said of a conclusion."""
TOLD_APART = (5.0, 95.0)
"""Word errors in %: where all compared rows are beyond the same end, most utterances are all right or all wrong in each, and words say nothing."""
NORMED = {systems.BATCH_NORM: "paper-crnn-narrow"}
"""A network with batch normalisation, and the row that it is compared with."""
COUNTED = ("insertions", "deletions")
"""Of the words, over all words."""
WORST = 10
"""Clips that the page names."""
NOTES = """Mean [95 % interval], drawn over speakers and rooms, not over utterances. WER: word errors over the span in which
the human speaks, an utterance counted as at most 100 %; 'uncapped' and 'median' are of the utterances' own rates, 'pooled' is
over all words, 'put in' and 'left out' are words over all words. ERLE: the last seconds of robot alone before the human.
AECMOS: 1 to 5, for echo and for the human. Compute: seconds for 5 s of sound on one core; learning, which a robot does
in another process, has none. Latency: of the windows alone; 'end' answers at the end. The last two columns are paired
differences on the same clips: below 0 is better in words, above 0 in dB."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("folders", type=Path, nargs="+", metavar="FOLDER")
    add("--systems", type=names, default=[], metavar="A,B,...", help="rows by name (default: all)")
    add("--network", type=named_file, action="append", default=[], metavar="NAME=FILE.onnx")
    add("--against", type=names, default=["crnn", "crnn-uncalibrated"], metavar="A,B,...",
        help="rows are compared with the first of these that ran on the clips")  # fmt: skip
    add("--speech", type=Path, metavar="DIR", help="humans to lay on real recordings")
    add("--laid-on", default="device1", metavar="PATTERN", help="devices (default: %(default)s)")
    add("--ser", type=numbers, default=Cells.sers, metavar="DB,...", help="human against echo, laid")
    add("--before", type=numbers, default=(5.0,), metavar="S,...", help="robot alone before, laid")
    add("--cases", type=int, default=8, metavar="N", help="humans laid at each level")


def names(text: str) -> list[str]:
    return text.split(",")


def numbers(text: str) -> tuple[float, ...]:
    return tuple(float(part) for part in text.split(","))


def named_file(text: str) -> tuple[str, Path]:
    name, _, path = text.partition("=")
    if not path:
        raise argparse.ArgumentTypeError(f"'{text}', expected NAME=FILE.onnx")
    return name, Path(path)


def run(options: argparse.Namespace) -> str:
    clips = find_clips(options)
    here, absent = systems.present(systems.chosen(options.systems, dict(options.network)))
    data = {"recordings": options.folders} | ({"HUMAN": [options.speech]} if options.speech else {})
    models = {"WHISPER": options.whisper, "SECOND": options.second_whisper}
    models |= {one.name: one.model for one in here if one.model}
    made_with = provenance.stamp(data, [one.name for one in here], models)
    setup = runner.Setup(options.cache, options.whisper, tuple(options.network), options.second_whisper)
    rows = runner.run(clips, here, setup, options.jobs, options.scheduler)
    tables = [headline(rows), glance(rows, here), *groups(rows, here, options.against)]
    tables += [*recognisers(rows, here, options.against), *slices(rows, here)]
    tables += [worst_table(worst(rows, here), rows), results.absent(absent)]
    notes = "\n\n".join([NOTES, "What the source paper (Li, Hindriks & Kunneman 2024) concluded:", conclusions(rows)])
    parts = {"clips": results.columns(about(clips, rows)), "rows": results.columns(slim(rows))}
    return results.write(options.output, "evaluation", "Evaluation", made_with, tables, notes=notes, **parts)


def find_clips(options: argparse.Namespace) -> list[Clip]:
    """All clips below the folders, every n-th of each set, named by folder; raises UsageError without any."""
    sets: dict[str, list[Clip]] = {}
    for folder in options.folders:
        if not folder.is_dir():
            raise UsageError(f"{folder} is no folder, expected conversations or pairs of recordings: check the path")
        for below in [folder, *(path for path in sorted(folder.rglob("*")) if path.is_dir())]:
            found = [*recordings.conversation_clips(below), *_real(below, options)]
            if found:
                name, parent = below.resolve().name, below.resolve().parent.name
                name = name if name not in sets else f"{parent}/{name}"
                sets.setdefault(name, []).extend(recordings.named(found, name))
    clips = [clip for _, clip in recordings.every(sets, options.every, options.limit)]
    if not clips:
        found = f"{', '.join(map(str, options.folders))}: no */meta.json and no *_lpb and *_mic files"
        wanted = "conversations (make some with bench.simulate.conversations) or recordings of a real device"
        raise UsageError(f"{found}, expected {wanted}")
    return clips


def _real(folder: Path, options: argparse.Namespace) -> Iterator[Clip]:
    if not any(path.stem.endswith("_lpb") for path in folder.iterdir() if path.is_file()):
        return
    found = recordings.find_recordings(folder)
    laid_on = [one for one in found if one.kind == "farend" and fnmatch(one.device, options.laid_on)]
    yield from (recordings.recorded_clip(one) for one in found if one not in laid_on)
    kept = [one for one in laid_on if not one.tuned_on]
    if kept and options.speech:
        cells = Cells(options.ser, options.before)
        laid = recordings.lay(kept, options.speech, cells, options.cases, options.seed)
        yield from recordings.laid_clips(laid, options.speech, "real loudspeaker")


def metric(rows: Sequence[dict]) -> tuple[str, int, str, int]:
    """The figure by which rows are compared: key, digits, heading, 1 where higher is worse, else -1; word errors, or SI-SDR without a recogniser."""
    words = any(row.get("capped") is not None for row in rows)
    return ("capped", 0, "WER, %", 1) if words else ("si_sdr", 1, "SI-SDR, dB", -1)


def of(rows: Sequence[dict], system: str, part: str = "") -> list[dict]:
    """The rows of a system, of all sets or of one."""
    return [row for row in rows if row["system"] == system and part in ("", row["set"])]


def grouped(rows: Sequence[dict]) -> dict[tuple[str, str], list[dict]]:
    found: dict[tuple[str, str], list[dict]] = {}
    for row in rows:
        found.setdefault((row["set"], row["room"]), []).append(row)
    return found


def counted(rows: Sequence[dict]) -> int:
    return len({row["clip"] for row in rows})


def headline(rows: Sequence[dict]) -> dict:
    """The rows of HEADLINE: SI-SDR and words of each set and room in which a human is known, and words less PAIRED on the same clips."""
    parts = {key: own for key, own in grouped(rows).items() if any(row.get("si_sdr") is not None for row in own)}
    known = systems.catalogue()
    cells = []
    for name in HEADLINE:
        texts = []
        for own in parts.values():
            ratio, wrong = (mean(of(own, name), key) for key in ("si_sdr", "capped"))
            both = ratio and wrong
            texts.append(f"{ratio['mean']:.1f} / {results.cell(wrong, 0)}" if both else results.cell(ratio, 1))
        if any(texts):
            less = None if name == PAIRED else difference(of(rows, name), of(rows, PAIRED), "capped")
            cells.append([known[name].title, known[name].knows, *texts, less])
    titles = [_title(key, own) for key, own in parts.items()]
    columns = ["SI-SDR, dB / words wrong, %", "knows", *titles, (f"words less {known[PAIRED].title}", 0)]
    return results.table("headline", "In short", columns, cells)


def _title(key: tuple[str, str], rows: Sequence[dict]) -> str:
    return f"{key[0]}, {key[1]} ({counted(rows)})"


def glance(rows: Sequence[dict], here: Sequence[System]) -> dict:
    """Systems down, sets and rooms across, one figure each."""
    key, digits, said, _ = metric(rows)
    parts = {name: own for name, own in grouped(rows).items() if mean(own, key)}
    cells = [[one.title, one.knows, *(mean(of(own, one.name), key) for own in parts.values())] for one in here]
    columns = ["system", "knows", *((_title(name, own), digits) for name, own in parts.items())]
    text = f"{said}; of each set and room, with its number of clips."
    return results.table("glance", "At a glance", columns, cells, text)


def groups(rows: Sequence[dict], here: Sequence[System], against: Sequence[str]) -> list[dict]:
    found = []
    for (name, room), own in grouped(rows).items():
        other = compared_with(own, against)
        columns = ["system", "knows", ("WER %", 0), ("uncapped", 0), ("median", 0), ("pooled", 0), ("put in", 0),
                   ("left out", 0), ("SI-SDR dB", 1), ("median", 1), ("ESTOI", 2), ("ERLE dB", 1), ("echo MOS", 1),
                   ("human MOS", 1), ("compute s", 2), "latency ms", (f"WER less {other}", 0), (f"dB less {other}", 1)]  # fmt: skip
        cells = [_cells(one, of(own, one.name), of(own, other)) for one in here]
        speakers = len({row["speaker"] for row in own})
        title = f"{name}, {room}: {counted(own)} clips of {speakers} speakers"
        found.append(results.table(f"{name}-{room}".replace(" ", "-"), title, columns, [row for row in cells if row]))
    return found


def compared_with(rows: Sequence[dict], against: Sequence[str]) -> str:
    """The first of these systems that ran on clips with a human, "" without one."""
    return next((one for one in against if any(row.get("si_sdr") is not None for row in of(rows, one))), "")


def recognisers(rows: Sequence[dict], here: Sequence[System], against: Sequence[str]) -> list[dict]:
    """What both recognisers understand, a row for each set, room and system; no table without a second one."""
    cells, kinds = [], ("", SECOND)
    for (name, room), own in grouped(rows).items():
        other = compared_with(own, against)
        for one in here:
            mine = of(own, one.name)
            if mean(mine, f"{SECOND}capped"):
                wrong = [mean(mine, f"{kind}capped") for kind in kinds]
                shares = [middle(pooled(mine, f"{kind}{key}", f"{kind}words")) for kind in kinds for key in COUNTED]
                less = [
                    None if one.name == other else difference(mine, of(own, other), f"{kind}capped") for kind in kinds
                ]
                cells.append(
                    [f"{name}, {room}", one.title, wrong[0], *shares[:2], less[0], wrong[1], *shares[2:], less[1]]
                )
    columns = [(head, 0) for kind in ("", "second: ") for head in
               (f"{kind}WER %", f"{kind}put in", f"{kind}left out", f"{kind}WER less")]  # fmt: skip
    text = f"'less': than {' or '.join(against)}, the first that ran, on the same clips."
    title = "Two recognisers"
    return [results.table("recognisers", title, ["set, room", "system", *columns], cells, text)] if cells else []


def _cells(one: System, own: Sequence[dict], other: Sequence[dict]) -> list | None:
    ran = [row for row in own if "absent" not in row]
    if not ran:
        return None
    unusable = sum("problem" in row for row in ran)
    title = one.title + (f" ({unusable} outputs unusable)" if unusable else "")
    wer, ratio = mean(ran, "wer"), mean(ran, "si_sdr")
    words = [mean(ran, "capped"), middle(wer), wer and wer["median"], pooled(ran, "errors", "words")]
    words += [middle(pooled(ran, key, "words")) for key in COUNTED]
    plain = [middle(mean(ran, key)) for key in ("estoi", "erle_db", "echo_mos", "human_mos")]
    timed = [row for row in ran if "seconds" in row and "duration" in row]
    compute = 5 * sum(row["seconds"] for row in timed) / sum(row["duration"] for row in timed) if timed else None
    late = ("" if one.kind == "bound" else "end") if one.latency_ms is None else f"{one.latency_ms:.0f}"
    same = not other or other[0]["system"] == one.name
    differences = [None, None] if same else [difference(ran, other, key) for key in ("capped", "si_sdr")]
    return [title, one.knows, *words, ratio, ratio and ratio["median"], *plain, compute, late, *differences]


def slices(rows: Sequence[dict], here: Sequence[System]) -> list[dict]:
    """Of each quantity a table: systems down, parts of about as many clips each across."""
    key, digits, said, _ = metric(rows)
    shown = [one for one in here if one.name in CUT]
    human = [row for row in rows if row.get(key) is not None]
    found = []
    for quantity in QUANTITIES:
        known = [row for row in human if quantity.key in row["facts"]]
        values = {row["clip"]: row["facts"][quantity.key] for row in known}
        edges = np.unique(np.quantile(list(values.values()), np.linspace(0, 1, PARTS + 1))) if values else np.zeros(0)
        if len(edges) < 3 or len(values) < PARTS:
            continue
        parts = {}
        for low, high in zip(edges, edges[1:]):
            inside = {clip for clip, x in values.items() if low <= x and (x < high or high == edges[-1])}
            part = [row for row in known if row["clip"] in inside]
            parts[f"{low:.{quantity.digits}f} to {high:.{quantity.digits}f} ({len(inside)})"] = part
        cells = [[one.title, *(mean(of(part, one.name), key) for part in parts.values())] for one in shown]
        columns = [quantity.title, *((head, digits) for head in parts)]
        found.append(results.table(f"by-{quantity.key}", f"{said} by: {quantity.title}", columns, cells))
    return found


def worst(rows: Sequence[dict], here: Sequence[System]) -> list[dict]:
    """The clips on which our best system has the worst figure (words, or SI-SDR without a recogniser), worst first."""
    key, _, _, worse = metric(rows)
    candidates = ("crnn", "crnn-uncalibrated", *(one.name for one in here))
    mine = next(filter(None, (of(rows, name) for name in candidates)), [])
    known = [row for row in mine if row.get(key) is not None]
    return sorted(known, key=lambda row: (-worse * row[key], row.get("si_sdr", 0.0)))[:WORST]


def worst_table(found: Sequence[dict], rows: Sequence[dict]) -> dict:
    title = f"The {len(found)} clips on which {found[0]['system']} does worst" if found else "Worst clips"
    shown = dict.fromkeys(("unfiltered", found[0]["system"] if found else "clean", "clean"))
    cells = []
    for row in found:
        of_clip = {one["system"]: one.get("transcript", "") for one in rows if one["clip"] == row["clip"]}
        heard = [of_clip.get(name, "") for name in shown]
        cells.append([row["clip"], row.get("capped"), row.get("si_sdr"), row["text"] or "", *heard])
    columns = ["clip", ("WER, %", 0), ("SI-SDR, dB", 1), "said", *(f"recognised, {name}" for name in shown)]
    return results.table("worst", title, columns, cells)


# ---------------------------------------------------------------- the source paper's conclusions


def conclusions(rows: Sequence[dict]) -> str:
    return "\n".join(f"- {line}" for line in (_volume_and_pitch(rows), _reverberation(rows), _batch_norm(rows)))


def _saturated(rows: Sequence[dict], compared: Sequence[str]) -> bool:
    wrong = [found["mean"] for name in compared if (found := mean(of(rows, name), "capped"))]
    return bool(wrong) and (max(wrong) < TOLD_APART[0] or min(wrong) > TOLD_APART[1])


def _measures(rows: Sequence[dict], compared: Sequence[str]) -> list[tuple[str, int, str]]:
    """Words where there is a recogniser and they tell these systems apart, and dB, which end at no 100 %; 1 where more is worse; the unit."""
    words = [("capped", 1, "points of WER")] if metric(rows)[0] == "capped" and not _saturated(rows, compared) else []
    return [*words, ("si_sdr", -1, "dB")]


def _network(rows: Sequence[dict]) -> str:
    """The source paper's network, or the narrower one of its shape; no other stands for it, and nothing is said without."""
    return next((name for name in ("paper-crnn", "paper-crnn-narrow") if of(rows, name)), "")


def _volume_and_pitch(rows: Sequence[dict]) -> str:
    key, _, said, worse = metric(rows)
    title, compared = "A loud or high-pitched human is understood better", ("paper-ss", _network(rows))
    if key == "capped" and _saturated(rows, compared):
        return f"{title}: not tested, the words are saturated."
    signs, told = [], []
    for fact, name in (("level_db", "level"), ("pitch_hz", "pitch")):
        for system in compared:
            if found := correlation(of(rows, system), fact, key):
                told.append(f"{name} and {system} {found[0]:+.2f} [{found[1]:+.2f}, {found[2]:+.2f}]")
                signs.append(_sign(-worse * found[1], -worse * found[2]))
    figures = f"Rank correlation with {said}: {'; '.join(told)}." if told else ""
    return _verdict(title, signs, figures)


def _reverberation(rows: Sequence[dict]) -> str:
    """By how much more the office costs paper-ss than the network."""
    title = "Spectral subtraction suffers from reverberation, the network less"
    network = _network(rows)
    signs, told = [], []
    for key, worse, unit in _measures(rows, ("paper-ss", network)):
        draws = {}
        for system in ("paper-ss", network):
            own = [row for row in of(rows, system) if row.get(key) is not None and row["room"] in ("lab", "office")]
            rooms = {room: np.array([row["room"] == room for row in own]) for room in ("lab", "office")}
            if min(inside.sum() for inside in rooms.values()) < FEW // 2:
                return _verdict(title, [], "")
            found = np.array([row[key] for row in own], np.float64)
            means = {room: _weighted(_weights(own) * inside, found) for room, inside in rooms.items()}
            draws[system] = means["office"] - means["lab"]
        low, high = np.nanpercentile(worse * (draws["paper-ss"] - draws[network]), [2.5, 97.5])
        signs.append(_sign(low, high))
        each = (f"{name} {np.nanmedian(rise):+.1f}" for name, rise in draws.items())
        told.append(f"{', '.join(each)} {unit} (apart [{low:+.1f}, {high:+.1f}])")
    return _verdict(title, signs, f"From the laboratory to the office: {'; '.join(told)}.")


def _weights(rows: Sequence[dict]) -> np.ndarray:
    return metrics.cluster_weights(*(tuple(row[part] for row in rows) for part in ("speaker", "place")))


def _weighted(weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    sums = weights.sum(axis=1)
    return np.where(sums > 0, weights @ values / np.maximum(sums, 1e-9), np.nan)


def _batch_norm(rows: Sequence[dict]) -> str:
    """Contradicted only where it does help."""
    signs, told = [], []
    for key, worse, unit in _measures(rows, [*NORMED, *NORMED.values()]):
        for normed, without in NORMED.items():
            found = difference(of(rows, normed), of(rows, without), key)
            if found and found["count"] >= FEW:
                signs.append(1 if max(worse * found["low"], worse * found["high"]) >= 0 else -1)
                told.append(f"{without} {found['mean']:+.1f} [{found['low']:+.1f}, {found['high']:+.1f}] {unit}")
    figures = f"With it less without: {'; '.join(told)}." if told else ""
    return _verdict("Batch normalisation does not help", signs, figures)


def correlation(rows: Sequence[dict], fact: str, key: str) -> tuple[float, float, float] | None:
    """Spearman's rank correlation of a quantity with a figure, and its interval; None with fewer than FEW clips.

    Ranks are within a set and room, so that what differs between rooms is not taken for the quantity.
    """
    x, y, members = [], [], []
    for own in grouped([row for row in rows if row.get(key) is not None and fact in row["facts"]]).values():
        if len(own) > 1:
            x.append((rankdata([row["facts"][fact] for row in own]) - 1) / len(own))
            y.append((rankdata([row[key] for row in own]) - 1) / len(own))
            members += own
    if len(members) < FEW:
        return None
    ranks = np.concatenate(x), np.concatenate(y)
    low, high = np.nanpercentile(_correlated(_weights(members), *ranks), [2.5, 97.5])
    return float(_correlated(np.ones((1, len(members))), *ranks)[0]), float(low), float(high)


def _correlated(weights: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    mean_x, mean_y, mean_xy = (_weighted(weights, z) for z in (x, y, x * y))
    spread = (_weighted(weights, x**2) - mean_x**2) * (_weighted(weights, y**2) - mean_y**2)
    return np.where(spread > 1e-9, (mean_xy - mean_x * mean_y) / np.sqrt(np.maximum(spread, 1e-9)), np.nan)


def _sign(low: float, high: float) -> int:
    low, high = sorted((low, high))
    return 1 if low > 0 else -1 if high < 0 else 0


def _verdict(title: str, signs: Sequence[int], figures: str) -> str:
    """As concluded where every sign is for it, the opposite where every one is against it."""
    if not signs:
        return f"{title}: not tested, too few clips or systems."
    verdict = "partly seen here" if max(signs) > 0 else "not seen here"
    if min(signs) > 0:
        verdict = "seen here as well"
    elif max(signs) < 0:
        verdict = "the opposite is seen here"
    return f"{title}: {verdict}. {figures}"


def about(clips: Sequence[Clip], rows: Sequence[dict]) -> list[dict]:
    known = {row["clip"]: row["facts"] for row in rows}
    told = ({quantity.key: known[clip.name].get(quantity.key) for quantity in QUANTITIES} for clip in clips)
    return [{"clip": clip.name, "room": clip.room, "speaker": clip.speaker, **of} for clip, of in zip(clips, told)]


def slim(rows: Sequence[dict]) -> list[dict]:
    """The figures without what `about` says of the clip, and without transcripts, which stay in the cache."""
    left_out = ("set", "room", "speaker", "place", "facts", "transcript", f"{SECOND}transcript", "text")
    return [{key: value for key, value in row.items() if key not in left_out} for row in rows]
