r"""How far the SI-SDR that a passport predicts is from what other humans have on the same device.

    python -m bench passport RECORDINGS --speech HUMAN --output PATH

RECORDINGS as of `python -m bench devices`; only the robots that talk alone. The passport lays the bundled voice on at each
level; then humans of --speech are laid on at that level after a time drawn from --before, and what they have is compared.
On a device of many recordings (DEVICE_00, ...) the passport is of the recording before the one on which it is checked.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np

from bench import provenance, recordings, results
from bench.evaluate import names, numbers
from bench.recordings import Recording
from edgefilter.commands.demo import speaking
from edgefilter.diagnosis.passport import ENGINES, LEAST_S, MOST_S, expected
from edgefilter.dsp.metrics import si_sdr
from edgefilter.errors import UsageError
from edgefilter.filter.budget import DEMO
from edgefilter.filter.ego_filter import enhance
from edgefilter.types import SAMPLE_RATE

NOTES = """SI-SDR, dB, of humans laid on, against the prediction of `edgefilter passport` at the same level. Error: predicted less
measured; a human is one case, a device the mean of its humans. Median and worst are of absolute errors."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("recordings", type=Path, metavar="RECORDINGS")
    add("--speech", type=Path, required=True, metavar="DIR", help="humans, with a transcripts.tsv")
    add("--engines", type=names, default=list(ENGINES), metavar="A,B,...", help="default: %(default)s")
    add("--humans", type=int, default=2, metavar="N", help="on each recording, at each level")
    add("--levels", type=numbers, default=(-10.0,), metavar="DB,...", help="human against echo")
    add("--before", type=numbers, default=(5.0, 12.0), metavar="LOW,HIGH", help="robot alone before, s")


def run(options: argparse.Namespace) -> str:
    found = list(cases(options))
    if not found:
        lacks = f"no recording of a robot alone of {LEAST_S:.0f} s or more"
        raise UsageError(f"{options.recordings} holds {lacks}, expected some")
    data = {"RECORDINGS": [options.recordings], "HUMAN": [options.speech]}
    made_with = provenance.stamp(data, [f"{engine}-uncalibrated" for engine in options.engines])
    devices = list(dict.fromkeys(row["device"] for row in found))
    cells, errors = [], []
    for device in devices:
        for engine in options.engines:
            own = [row for row in found if (row["device"], row["engine"]) == (device, engine)]
            predicted, measured = (float(np.mean([row[key] for row in own])) for key in ("predicted", "measured"))
            errors.append({"engine": engine, "error": predicted - measured})
            cells.append([device[:8], engine, len(own), predicted, measured, predicted - measured])
    columns = ["device", "engine", "humans", ("predicted, dB", 1), ("measured, dB", 1), ("error, dB", 1)]
    single = [{"engine": row["engine"], "error": row["predicted"] - row["measured"]} for row in found]
    tables = [results.table("devices", "By device", columns, cells)]
    columns = ["of", "engine", "cases", ("median, dB", 1), ("worst, dB", 1), ("mean, dB", 1)]
    each = product((("devices", errors), ("humans", single)), (*options.engines, "all"))
    cells = [summary(of, engine, some) for (of, some), engine in each]
    tables.insert(0, results.table("error", "Error of the prediction", columns, cells))
    return results.write(options.output, "passport", "Passports", made_with, tables, notes=NOTES, rows=found)


def summary(of: str, engine: str, some: list[dict]) -> list:
    """Median and worst of absolute errors and the mean error, of one engine or all."""
    own = np.array([row["error"] for row in some if engine in ("all", row["engine"])])
    return [of, engine, own.size, float(np.median(abs(own))), float(abs(own).max()), float(own.mean())]


def cases(options: argparse.Namespace) -> Iterator[dict]:
    voice = recordings.read(DEMO / "human.flac")
    voice = voice[speaking(voice)]
    alone = [one for one in recordings.find_recordings(options.recordings) if one.kind == "farend"]
    alone = alone[:: options.every][: options.limit]
    for at, one in enumerate(alone):
        before = alone[at - 1] if at and alone[at - 1].device == one.device else one
        if before is one and any(other.device == one.device for other in alone[at + 1 : at + 2]):
            continue
        seen = before.signals()
        if seen.mic.size < LEAST_S * SAMPLE_RATE:
            continue
        most = round(MOST_S * SAMPLE_RATE)
        for level in options.levels:
            about = options.humans, (level, level), options.before, options.seed
            humans = recordings.lay_once(one, options.speech, *about)
            for engine in options.engines:
                _, predicted = expected(seen.mic[:most], seen.ref[:most], voice, level, engine)
                for human in humans:
                    yield _case(one, engine, level, predicted, human)


def _case(one: Recording, engine: str, level: float, predicted: float, laid: recordings.Laid) -> dict:
    signals = laid.signals()
    output = enhance(signals.mic, signals.ref, engine=engine)
    assert signals.human is not None
    measured = si_sdr(output[signals.span], signals.human[signals.span])
    return {"device": one.device, "recording": one.name, "engine": engine, "level": level, "human": laid.speech.name,
            "predicted": predicted, "measured": measured}  # fmt: skip
