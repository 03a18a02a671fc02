"""The page and the picture of a live trial."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bench import results_writer
from bench.measure import picture
from bench.measure.real_barge_in import IN_TIME_S

SOUNDS = ("human alone", "microphone", "output")


def title(found: dict) -> str:
    """How long."""
    return f"Live: {found['minutes']:.0f} minutes over virtual devices, with mishaps"


def markdown(found: dict, name: str) -> str:
    """The page below its title; name: of the picture beside it, without suffix."""
    stats, source = found["stats"], found["stats"]["source"]
    deadline = stats["deadline"]
    lines = [
        f"Load average before {found['load_average_before']:.1f}. A simulated robot, heard in real time by",
        "loopback and microphone of sound servers of their own; everything else is as on a robot.",
        "",
        "What was done to it:",
        "",
    ]
    doings = [(m["begin_s"], f"{m['name']}, {m['end_s'] - m['begin_s']:.0f} s") for m in found["mishaps"]]
    doings += [(stage["begin_s"], stage["name"]) for stage in found["stages"]]
    lines += results_writer.table(["at", "what"], [[_clock(at), what] for at, what in sorted(doings)])
    lines += ["", "What the run counted:", ""]
    counts = [["samples in, out", f"{stats['samples_in']}, {stats['samples_out']}"]]
    counts += [[key.replace("_", " "), str(value)] for key, value in source.items() if value]
    counts += [["hops late", f"{deadline['missed_deadlines']} of {deadline['hops']}"]]
    counts += [["ms a hop, p50 / p99", f"{deadline['compute']['p50_ms']:.1f} / {deadline['compute']['p99_ms']:.1f}"]]
    counts += [["steps between engines", str(deadline["steps"])], ["engine at the end", stats["engine"]]]
    lines += results_writer.table(["", ""], counts)
    lines += [
        "",
        "The human, by what was going on:",
        "",
        *_words(found),
        "",
        "Every interruption:",
        "",
        *_sentences(found),
    ]
    lines += ["", "Events, those of speech left out:", "", *_events(found["events"])]
    return "\n".join([*lines, "", f"![the trial]({name}.png)", ""])


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{seconds % 60:04.1f}"


def _going_on(sentence: dict) -> str:
    return ", ".join(sentence["during"]) or sentence["stage"]


def _words(found: dict) -> list[str]:
    """A row for each stage and mishap, and one for all."""
    sentences = found["sentences"]
    names = list(dict.fromkeys(_going_on(sentence) for sentence in sentences))
    rows = []
    for name in [*names, "all"]:
        chosen = [sentence for sentence in sentences if name in ("all", _going_on(sentence))]
        soon = sum(s["noticed_s"] is not None and s["noticed_s"] <= IN_TIME_S for s in chosen)
        row = [name, str(len(chosen)), f"{soon} of {len(chosen)}"]
        if "wrong" in chosen[0]:
            row += [f"{100 * mean_wrong(chosen, sound):.0f}" for sound in SOUNDS]
        rows.append(row)
    wrong = [f"{sound}, capped WER %" for sound in SOUNDS if sentences and "wrong" in sentences[0]]
    return results_writer.table(["during", "interruptions", f"noticed within {IN_TIME_S:g} s", *wrong], rows)


def mean_wrong(sentences: Sequence[dict], sound: str) -> float:
    """Capped word error rate, each sentence weighing as many words as it has."""
    words = [sentence["words"] for sentence in sentences]
    return float(np.average([sentence["wrong"][sound] for sentence in sentences], weights=words))


def _sentences(found: dict) -> list[str]:
    rows = []
    for sentence in found["sentences"]:
        soon = "never" if sentence["noticed_s"] is None else f"{sentence['noticed_s']:.2f}"
        rows.append(
            [_clock(sentence["begin_s"]), soon, _going_on(sentence), sentence["text"], sentence.get("heard", "")]
        )
    return results_writer.table(["at", "noticed after, s", "during", "said", "recognised"], rows)


def _events(events: Sequence[dict]) -> list[str]:
    """Events but those of speech; of a kind that comes often, how often."""
    kept = [event for event in events if not event["kind"].startswith("speech")]
    counts = Counter(event["kind"] for event in kept)
    rows = [[_clock(e["time"]), e["kind"], e.get("detail", "")] for e in kept if counts[e["kind"]] <= 12]
    often = [f"{count} times {kind}" for kind, count in counts.items() if count > 12]
    return [*results_writer.table(["at", "event", ""], rows), *(["", f"And {', '.join(often)}."] if often else [])]


def draw(found: dict, output: Path) -> None:
    """Interruptions by when they were noticed and how many words were wrong, over the mishaps."""
    figure, axes = picture.panels(2, 1, (11, 6))
    sentences = found["sentences"]
    minutes = [sentence["begin_s"] / 60 for sentence in sentences]
    after = [np.nan if s["noticed_s"] is None else min(s["noticed_s"], 2.0) for s in sentences]
    axes[0].plot(minutes, after, "o", color="#33658a")
    axes[0].axhline(IN_TIME_S, color="black", linewidth=0.6, linestyle="--")
    axes[0].set(ylabel="noticed after, s (2: or later)", ylim=(-0.15, 2.1))
    if sentences and "wrong" in sentences[0]:
        for sound, marker, colour in zip(SOUNDS, ("_", "x", "o"), ("#444444", "#b3412b", "#33658a"), strict=True):
            wrong = [100 * sentence["wrong"][sound] for sentence in sentences]
            axes[1].plot(minutes, wrong, marker, color=colour, label=sound)
        axes[1].legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    axes[1].set(ylabel="words wrong, %, at most 100")
    for axis in axes:
        across = axis.get_xaxis_transform()
        axis.set(xlabel="minutes", xlim=(0, found["minutes"]))
        axis.grid(alpha=0.3)
        for mishap in found["mishaps"]:
            axis.axvspan(mishap["begin_s"] / 60, mishap["end_s"] / 60, color="#f2c14e", alpha=0.5)
            axis.text(mishap["begin_s"] / 60, 0.9, mishap["name"], fontsize=7, transform=across)
        for stage in found["stages"]:
            axis.axvline(stage["begin_s"] / 60, color="black", linewidth=0.6, linestyle=":")
    for stage in found["stages"]:
        axes[0].text(stage["begin_s"] / 60, 1.01, stage["name"], fontsize=7, transform=axes[0].get_xaxis_transform())
    picture.save(figure, output)
