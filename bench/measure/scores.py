"""From per-utterance scores to the tables of SI-SDR and word errors: means, medians, bootstrap intervals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.measure.intervals import interval
from bench.results_writer import table

COLUMNS = ("engine", "SI-SDR dB", "median", "WER %", "median", "capped WER %", "RTF")


def summarise(scores: Sequence[dict]) -> dict:
    """Figures of one engine in one room.

    scores: per utterance si_sdr (dB; None for the clean signal itself), errors and words (if recognised), seconds,
    duration, problem.

    wer is pooled (all errors over all words), wer_mean the mean of each utterance's own rate (as in the source paper),
    wer_capped the mean of min(rate, 1). All in %. Utterances with a problem (length, NaN) are counted and left out of
    the figures.
    """
    good = [score for score in scores if not score.get("problem")]
    row: dict = {"utterances": len(scores), "problems": len(scores) - len(good)}
    if not good:
        return row
    if all(score["si_sdr"] is not None for score in good):
        si_sdr = [score["si_sdr"] for score in good]
        row["si_sdr_mean"], row["si_sdr_median"] = float(np.mean(si_sdr)), float(np.median(si_sdr))
        row["si_sdr_interval"] = interval(lambda x: x.mean(axis=1), si_sdr)
    row["real_time_factor"] = float(np.sum([s["seconds"] for s in good]) / np.sum([s["duration"] for s in good]))
    if "words" in good[0]:
        errors, words = (np.array([score[key] for score in good], np.float64) for key in ("errors", "words"))
        rates = 100 * errors / words
        row["words"], row["wer"] = int(words.sum()), float(100 * errors.sum() / words.sum())
        row["wer_interval"] = interval(lambda e, w: 100 * e.sum(axis=1) / w.sum(axis=1), errors, words)
        row["wer_mean"], row["wer_median"] = float(rates.mean()), float(np.median(rates))
        row["wer_mean_interval"] = interval(lambda x: x.mean(axis=1), rates)
        row["wer_capped"] = float(np.minimum(rates, 100).mean())
        row["wer_capped_interval"] = interval(lambda x: x.mean(axis=1), np.minimum(rates, 100))
    return row


def markdown(summaries: dict[str, dict[str, dict[str, dict]]]) -> str:
    """The table as Markdown. summaries[set][room][engine] as from `summarise`."""
    lines = [
        "Scored over the span in which the human speaks: mean [95 % bootstrap interval over utterances]. WER by "
        "Whisper-base is"
    ]
    lines += [
        "pooled over all words, its median is of the utterances' own rates; 'capped' is the mean of those, each at "
        "most 100 %."
    ]
    lines += [
        "RTF: processing time over audio, one thread. '-true-lag': given each utterance's lag, which no robot knows."
    ]
    for set_name, rooms in summaries.items():
        for room, engines in rooms.items():
            first = next(iter(engines.values()))
            lines += [
                "",
                f"## {set_name}, {room}: {first['utterances']} conversations, {first.get('words', 'no')} words",
                "",
            ]
            lines += table(COLUMNS, [_cells(engine, row) for engine, row in engines.items()])
    return "\n".join(lines) + "\n"


def figure(row: dict, key: str, digits: int) -> str:
    """A mean with its interval: key is si_sdr_mean, or one of wer, wer_mean, wer_capped."""
    low, high = row[f"{'si_sdr' if key == 'si_sdr_mean' else key}_interval"]
    return f"{row[key]:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def _cells(engine: str, row: dict) -> list[str]:
    name = engine + (f" ({row['problems']} outputs unusable)" if row["problems"] else "")
    if row["problems"] == row["utterances"]:
        return [name, *[""] * (len(COLUMNS) - 1)]
    cells = [name, "", ""]
    if "si_sdr_mean" in row:
        cells = [name, figure(row, "si_sdr_mean", 1), f"{row['si_sdr_median']:.1f}"]
    if "wer" in row:
        cells += [figure(row, "wer", 0), f"{row['wer_median']:.0f}", figure(row, "wer_capped", 0)]
    else:
        cells += [""] * 3
    return [*cells, f"{row['real_time_factor']:.3f}"]
