r"""Every real device in one table, a row a device: nothing is known beforehand, nothing is calibrated.

    python -m bench devices RECORDINGS ... --speech HUMAN --whisper WHISPER --output PATH

Each folder RECORDINGS holds pairs NAME_lpb (what the loudspeaker was sent) and NAME_mic, 16 kHz mono. Where the robot talks alone,
humans of --speech are laid on: on a device's only recording at a level and after a time drawn from --ser and --before;
on a device of many recordings (DEVICE_00, ...) at each of --levels, on the half that is kept to report on. The same
recordings whole tell how far the robot alone is lowered, and every speech_started in them is false. Pairs in which both
talk, or the human alone, are scored as recorded, by AECMOS. Devices that match --tuned-on were looked at while the
filter was made: they stand in tables of their own.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from bench import provenance, recordings, results, runner, systems
from bench.detectors import DETECTORS
from bench.evaluate import names, numbers, of, slim
from bench.metrics import IN_TIME_S, delays_s, difference, later, mean, per_hour
from bench.recordings import Cells, Clip, Recording
from bench.systems import System

DEFAULT = ("unfiltered", *(f"{engine}-uncalibrated{way}" for way in ("", "-learning") for engine in systems.OWN),
           *systems.PEERS, "clean")  # fmt: skip
TUNED_ON = "F_i0k*,1N-e5*,yw9vi*,0B-YT*,0sjDo*,gf_0sK*,gf_6558*,realaec*,nanless*,smird*,wade*"
"""The devices whose recordings were there to look at and to tune on."""
GLANCE = (
    "unfiltered+silero",
    "speexdsp-suppressed+silero",
    "aec3+silero",
    "crnn-uncalibrated+silero",
    "crnn-uncalibrated",
)
"""Rows of the table that README.md quotes."""
SOON_S = 0.5
"""A human who interrupts is to be noticed by then."""
AHEAD_DB = 1.0
"""The best peer counts as ahead on a device by more than this."""
NOTES = """SI-SDR and word errors (at most 100 % an utterance) over the human who was laid on; the robot alone: by how much
its recordings are lowered as a whole, and the median of their frames; false starts: every `speech_started` in them. Means
are of devices, each with the same weight, and so are their 95 % intervals; differences are paired by device. 'Kept apart' are
a device that was not looked at while the filter was made, and the second half of one whose first half was tuned on; the
others stand apart. Peers get microphone and reference as the engines do."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("recordings", type=Path, nargs="+", metavar="RECORDINGS")
    add("--speech", type=Path, required=True, metavar="DIR", help="humans, with a transcripts.tsv")
    add("--systems", type=names, default=list(DEFAULT), metavar="A,B,...", help="default: %(default)s")
    add("--tuned-on", type=names, default=names(TUNED_ON), metavar="A,B,...", help="default: %(default)s")
    add("--humans", type=int, default=2, metavar="N", help="on each device of one recording")
    add("--ser", type=numbers, default=(-14.0, -6.0), metavar="LOW,HIGH", help="human against echo, dB")
    add("--before", type=numbers, default=(5.0, 12.0), metavar="LOW,HIGH", help="robot alone before, s")
    add("--levels", type=numbers, default=Cells.sers, metavar="DB,...", help="on devices of many recordings")
    add("--cases", type=int, default=8, metavar="N", help="humans at each of the levels")


def run(options: argparse.Namespace) -> str:
    able, absent = systems.present(systems.chosen(options.systems))
    here = [one for one in able if one.kind != "detector"]
    clips = find_clips(options)
    data = {"RECORDINGS": options.recordings, "HUMAN": [options.speech]}
    made_with = provenance.stamp(data, [one.name for one in here], {"WHISPER": options.whisper})
    setup = runner.Setup(options.cache, options.whisper)
    rows = runner.run(clips, able, setup, options.jobs, options.scheduler)
    tuned_on = {clip.room for clip in clips if any(fnmatch(clip.room, one) for one in options.tuned_on)}
    kept, tuned = ([row for row in rows if (row["room"] in tuned_on) == told] for told in (False, True))
    parts = (("headline", "Devices kept apart", kept), ("tuned-on", "Devices tuned on", tuned))
    tables = [at_a_glance(kept, able), *(overview(*part, here) for part in parts)]
    tables += [who_interrupts(name, title, own, able) for name, title, own in parts]
    laid, alone = ([row for row in rows if row["set"] == part] for part in ("laid", "alone"))
    tables += [by_device("si_sdr", "SI-SDR of the human laid on, dB", laid, here, 1, tuned_on),
               by_device("capped", "Words wrong, %", laid, here, 0, tuned_on),
               by_device("erle_db", "The robot alone, lowered by dB", alone, here, 1, tuned_on)]  # fmt: skip
    tables += [against_peers(rows, here, tuned_on), barge_in(rows, here, tuned_on), as_recorded(rows, here)]
    tables.append(results.absent(absent))
    return results.write(options.output, "devices", "Real devices", made_with, [one for one in tables if one["rows"]],
                         notes=f"{NOTES} {levels(options)}", rows=results.columns(slim(rows)))  # fmt: skip


def levels(options: argparse.Namespace) -> str:
    many = ", ".join(f"{level:g}" for level in options.levels)
    return f"Humans are {' to '.join(f'{ser:g}' for ser in options.ser)} dB over the echo; on devices with many recordings, at each of {many} dB."


def find_clips(options: argparse.Namespace) -> list[Clip]:
    """Humans laid on, robots alone, and pairs as recorded; a clip's room is its device."""
    found: dict[str, list[Recording]] = {}
    for one in [one for folder in options.recordings for one in recordings.find_recordings(folder)]:
        if not one.tuned_on:
            found.setdefault(one.device, []).append(one)
    clips: list[Clip] = []
    for device, own in list(found.items())[:: options.every][: options.limit]:
        alone = [one for one in own if one.kind == "farend"]
        if alone and alone[0].many:
            cells = Cells(options.levels, (min(options.before),))
            laid = recordings.lay(alone, options.speech, cells, options.cases, options.seed)
        else:
            shortest = recordings.UTTERANCE_S[0] + recordings.TAIL_S
            long = [one for one in alone if one.span is None or one.seconds >= shortest]
            laid = [human for one in long for human in recordings.lay_once(
                one, options.speech, options.humans, options.ser, options.before, options.seed)]  # fmt: skip
        sets = {"laid": recordings.laid_clips(laid, options.speech, device)}
        sets["alone"] = (recordings.recorded_clip(one) for one in alone)
        sets["pairs"] = (recordings.recorded_clip(one) for one in own if one.kind != "farend")
        clips += [replace(clip, set=part, room=device) for part, some in sets.items() for clip in some]
    return clips


def per_device(rows: Sequence[dict], key: str) -> list[dict]:
    """A row for each device that has the figure: its mean, and the device as the cluster of an interval."""
    devices = dict.fromkeys(row["room"] for row in rows)
    means = {device: mean([row for row in rows if row["room"] == device], key) for device in devices}
    return [{"clip": d, "speaker": d, "place": d, key: found["mean"]} for d, found in means.items() if found]


def overview(name: str, title: str, rows: Sequence[dict], here: Sequence[System]) -> dict:
    """A row a system: means over devices, the worst device, and paired differences from `crnn` without learning."""
    devices, with_human = (
        len({row["room"] for row in part}) for part in (rows, [r for r in rows if r["set"] == "laid"])
    )
    columns = ["system", ("SI-SDR, dB", 1), ("worst device", 1), ("words wrong, %", 0), ("robot alone, dB", 1),
               ("worst device", 1), ("median frame", 1), "false starts", f"noticed in {SOON_S} s", ("dB less crnn", 1),
               ("words less crnn", 0)]  # fmt: skip
    cells = []
    for one in here:
        laid, alone = (of(rows, one.name, part) for part in ("laid", "alone"))
        ratio, lowered = per_device(laid, "si_sdr"), per_device(alone, "erle_db")
        base = of(rows, "crnn-uncalibrated", "laid") if one.name != "crnn-uncalibrated" else []
        less = [difference(per_device(laid, key), per_device(base, key), key) for key in ("si_sdr", "capped")]
        cells.append([one.title, mean(ratio, "si_sdr"), min((row["si_sdr"] for row in ratio), default=None),
                      mean(per_device(laid, "capped"), "capped"), mean(lowered, "erle_db"),
                      min((row["erle_db"] for row in lowered), default=None),
                      mean(per_device(alone, "erle_frames_db"), "erle_frames_db"), starts(alone), soon(laid), *less])  # fmt: skip
    return results.table(name, f"{title}: {devices}, a human laid on {with_human}", columns, cells if devices else [])


def at_a_glance(rows: Sequence[dict], able: Sequence[System]) -> dict:
    """The rows of GLANCE: what is left of the robot, what of the human, and how often the robot would stop because of itself."""
    known, cells, here = systems.catalogue(), [], {one.name for one in able}
    for name in (name for name in GLANCE if name in here):
        row, _, detector = name.partition("+")
        laid, alone = (of(rows, row, part) for part in ("laid", "alone"))
        told, heard = (of(rows, name, part) for part in ("alone", "laid"))
        title = f"edgefilter: {known[row].title}" if known[row].kind == "own" else known[row].title
        cells.append([title, mean(per_device(alone, "erle_db"), "erle_db"),
                      mean(per_device(laid, "si_sdr"), "si_sdr"), mean(per_device(laid, "capped"), "capped"),
                      DETECTORS[detector].title if detector else "edgefilter", starts(told), soon(heard)])  # fmt: skip
    columns = ["the microphone through", ("robot alone, lowered by dB", 0), ("human, SI-SDR in dB", 1), ("words wrong, %", 0),
               "who says that a human speaks", "false starts", f"humans noticed in {SOON_S} s"]  # fmt: skip
    return results.table("glance", "At a glance: devices kept apart", columns, cells)


def who_interrupts(name: str, title: str, rows: Sequence[dict], able: Sequence[System]) -> dict:
    """A row for each system and detector that tells who speaks: false starts, and how soon the humans are noticed."""
    cells = []
    for one in able:
        alone, laid = (of(rows, one.name, part) for part in ("alone", "laid"))
        told, heard = ([row for row in part if key in row] for part, key in ((alone, "false_starts"), (laid, "early")))
        if not told:
            continue
        count, hours = sum(row["false_starts"] for row in told), sum(row["duration"] for row in told) / 3600
        delays = delays_s(heard)
        within = [sum(delay <= limit for delay in delays) for limit in (IN_TIME_S, SOON_S)]
        cells.append([one.title, count, per_hour(count, hours), *within, milliseconds(later(delays, 0.5)),
                      sum(np.isinf(delays)), len(heard) - len(delays)])  # fmt: skip
    minutes = (
        sum({row["clip"]: row["duration"] for row in rows if row["set"] == "alone" and "duration" in row}.values()) / 60
    )
    humans = len({row["clip"] for row in rows if row["set"] == "laid"})
    columns = [
        "",
        "false starts",
        ("an hour", 0),
        f"noticed in {IN_TIME_S} s",
        f"in {SOON_S} s",
        ("median, ms", 0),
        "never",
        "already on",
    ]
    text = f"{minutes:.1f} minutes of the robot alone, {humans} humans. A detector hears what stands behind its name, as late as that comes."
    return results.table(f"interrupts-{name}", f"What interrupts the robot. {title}", columns, cells, text)


def milliseconds(delay_s: float | None) -> float | str | None:
    """A delay for a cell: in milliseconds, "never" where it is infinite."""
    return "never" if delay_s == np.inf else delay_s and 1000 * delay_s


def starts(alone: Sequence[dict]) -> str | None:
    """False starts, and in how many minutes."""
    told = [row for row in alone if row.get("false_starts") is not None]
    minutes = sum(row["duration"] for row in told) / 60
    return f"{sum(row['false_starts'] for row in told)} in {minutes:.1f} min" if told else None


def soon(laid: Sequence[dict]) -> str | None:
    """How many of the humans are noticed within SOON_S of their first sound."""
    told = [row for row in laid if "early" in row]
    count = sum(row["delay_s"] is not None and row["delay_s"] <= SOON_S for row in told)
    return f"{count} of {len(told)}" if told else None


def marked(device: str, tuned_on: set[str]) -> str:
    return f"{device[:8]} (tuned on)" if device in tuned_on else device[:8]


def by_device(
    key: str, title: str, rows: Sequence[dict], here: Sequence[System], digits: int, tuned_on: set[str]
) -> dict:
    """A row a device, the mean of its humans in each system's column; below, the mean of all devices and the worst."""
    shown = [one for one in here if per_device(of(rows, one.name), key)]
    found = {one.name: {row["clip"]: row[key] for row in per_device(of(rows, one.name), key)} for one in shown}
    devices = dict.fromkeys(row["room"] for row in rows)
    cells = [[marked(d, tuned_on), *(found[one.name].get(d) for one in shown)] for d in devices]
    if cells and shown:
        worse = max if key == "capped" else min
        cells.append(["mean", *(float(np.mean(list(found[one.name].values()))) for one in shown)])
        cells.append(["worst", *(worse(found[one.name].values()) for one in shown)])
    return results.table(key, title, ["device", *((one.title, digits) for one in shown)], cells if shown else [])


def against_peers(rows: Sequence[dict], here: Sequence[System], tuned_on: set[str]) -> dict:
    """By how much `crnn` is above the best peer of each device, in SI-SDR and words, human by human."""
    laid = [row for row in rows if row["set"] == "laid"]
    peers = [one for one in here if one.kind == "peer"]
    cells, ahead = [], 0
    for device in dict.fromkeys(row["room"] for row in laid):
        own = [row for row in laid if row["room"] == device]
        means = {one: found["mean"] for one in peers if (found := mean(of(own, one.name), "si_sdr"))}
        mine = of(own, "crnn-uncalibrated")
        if not means or not mine:
            continue
        best = max(means, key=lambda one: means[one])
        less = [difference(mine, of(own, best.name), key) for key in ("si_sdr", "capped")]
        ahead += less[0] is not None and less[0]["mean"] < -AHEAD_DB
        cells.append([marked(device, tuned_on), best.title, means[best], *less])
    columns = ["device", "best peer", ("its SI-SDR, dB", 1), ("crnn less it, dB", 1), ("words less its, points", 0)]
    text = f"The best peer is ahead of `crnn`, uncalibrated, by more than {AHEAD_DB:.0f} dB of SI-SDR on {ahead} of {len(cells)} devices."
    return results.table("peers", "Against the best peer of each device", columns, cells, text)


def barge_in(rows: Sequence[dict], here: Sequence[System], tuned_on: set[str]) -> dict:
    """A row for each device and system that tells who speaks."""
    cells = []
    for device in dict.fromkeys(row["room"] for row in rows):
        for one in here:
            own = of([row for row in rows if row["room"] == device], one.name)
            laid, alone = of(own, one.name, "laid"), of(own, one.name, "alone")
            if starts(alone) is None:
                continue
            told = [row for row in laid if "early" in row]
            early = sum(row["early"] for row in told)
            median = later(delays_s(told) + early * [np.inf], 0.5)
            cells.append([marked(device, tuned_on), one.title, starts(alone), soon(laid),
                          milliseconds(np.inf if median is None else median), early])  # fmt: skip
    columns = ["device", "system", "false starts", f"noticed in {SOON_S} s", ("median, ms", 0), "already on"]
    return results.table("barge-in", "Barge-in", columns, cells)


def as_recorded(rows: Sequence[dict], here: Sequence[System]) -> dict:
    """Clips as recorded, nothing mixed in: AECMOS for echo and human, SI-SDR re the microphone of a human alone."""
    pairs = [row for row in rows if row["set"] in ("pairs", "alone") and row.get("echo_mos") is not None]
    here = [one for one in here if one.kind != "bound" and not one.name.endswith(systems.TRUE_LAG)]
    cells = []
    for clip in dict.fromkeys(row["clip"] for row in pairs):
        own = {row["system"]: row for row in pairs if row["clip"] == clip}
        texts = []
        for row in (own.get(one.name, {}) for one in here):
            text = " / ".join(results.cell(row.get(key), 2) for key in ("echo_mos", "human_mos"))
            texts.append(text + (f"; {row['si_sdr_mic']:.1f} dB" if row.get("si_sdr_mic") else ""))
        device = next(row["room"] for row in pairs if row["clip"] == clip)
        cells.append([device[:8] + clip.partition(device)[2], *texts])
    title = "As recorded: AECMOS echo / human; where the human is alone, SI-SDR against the microphone"
    return results.table("as-recorded", title, ["recording", *(one.title for one in here)], cells)
