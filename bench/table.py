"""From per-utterance scores to the benchmark's table: means, medians, bootstrap intervals; JSON and Markdown."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime, timezone

import numpy as np

from edgefilter.filter.budget_cache import processor, versions

RESAMPLES = 2000
PACKAGES = ("numpy", "scipy", "onnxruntime", "faster-whisper", "ctranslate2", "jiwer", "pywebrtc-audio", "soundfile")


def interval(statistic: Callable[..., np.ndarray], *columns: Sequence[float]) -> tuple[float, float]:
    """95 % percentile bootstrap interval (Efron & Tibshirani 1993, ch. 13), resampling utterances; seeded, so that it repeats.

    columns: (n,) each, resampled together; statistic maps (RESAMPLES, n) arrays to (RESAMPLES,).
    """
    arrays = [np.asarray(column, np.float64) for column in columns]
    draws = np.random.default_rng(0).integers(0, arrays[0].size, size=(RESAMPLES, arrays[0].size))
    low, high = np.percentile(statistic(*(array[draws] for array in arrays)), [2.5, 97.5])
    return float(low), float(high)


def summarise(scores: Sequence[dict]) -> dict:
    """Figures of one engine in one room.

    scores: per utterance si_sdr (dB; None for the clean signal itself), errors and words (if recognised), seconds, duration, problem.

    wer is pooled (all errors over all words), wer_mean the mean of each utterance's own rate (as in the source paper), wer_capped
    the mean of min(rate, 1). All in %. Utterances with a problem (length, NaN) are counted and left out of the figures.
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


def markdown(summaries: dict[str, dict[str, dict[str, dict]]], machine: dict, note: str) -> str:
    """The table as Markdown. summaries[set][room][engine] as from `summarise`."""
    lines = [f"# {note}", "", ", ".join(f"{key} {value}" for key, value in machine.items()), ""]
    lines += ["Scored over the span in which the human speaks: mean [95 % bootstrap interval over utterances]. WER by Whisper-base is"]
    lines += ["pooled over all words, its median is of the utterances' own rates; 'capped' is the mean of those, each at most 100 %."]
    lines += ["RTF: processing time over audio, one thread. '-true-lag': given each utterance's lag, which no robot knows."]
    for set_name, rooms in summaries.items():
        for room, engines in rooms.items():
            first = next(iter(engines.values()))
            lines += ["", f"## {set_name}, {room}: {first['utterances']} conversations, {first.get('words', 'no')} words", ""]
            lines += ["| engine | SI-SDR dB | median | WER % | median | capped WER % | RTF |", "| --- " * 7 + "|"]
            lines += [_line(engine, row) for engine, row in engines.items()]
    return "\n".join(lines) + "\n"


def _line(engine: str, row: dict) -> str:
    name = engine + (f" ({row['problems']} outputs unusable)" if row["problems"] else "")
    if row["problems"] == row["utterances"]:
        return f"| {name} | | | | | | |"
    cells = [name, _figure(row, "si_sdr", "si_sdr_mean", 1), f"{row['si_sdr_median']:.1f}"] if "si_sdr_mean" in row else [name, "", ""]
    if "wer" in row:
        cells += [_figure(row, "wer", "wer", 0), f"{row['wer_median']:.0f}", _figure(row, "wer_capped", "wer_capped", 0)]
    else:
        cells += [""] * 3
    return "| " + " | ".join([*cells, f"{row['real_time_factor']:.3f}"]) + " |"


def _figure(row: dict, name: str, key: str, digits: int) -> str:
    low, high = row[f"{name}_interval"]
    return f"{row[key]:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def machine() -> dict[str, str]:
    """Processor, Python, package versions and the date, for the head of every result."""
    date = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    return {"date": date, "processor": processor(), "threads": "1", **versions(PACKAGES)}
