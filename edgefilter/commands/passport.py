"""`edgefilter passport`: what one recording of an unknown device tells, and what to expect of the filter there."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from edgefilter.commands.demo import speaking
from edgefilter.commands.display import print_result, progress, report_part
from edgefilter.commands.recordings import read
from edgefilter.diagnosis.passport import ENGINES, MOST_S, measure
from edgefilter.diagnosis.recording import Recording
from edgefilter.diagnosis.result import Diagnosis
from edgefilter.errors import SignalError
from edgefilter.filter.budget import DEMO
from edgefilter.report.passport import expectation, lines
from edgefilter.report.text import headline
from edgefilter.types import SAMPLE_RATE, Samples


def main(args: argparse.Namespace) -> None:
    html = report_part("html") if args.report else None
    most = round(MOST_S * SAMPLE_RATE)
    recording, reference = read(args.recording, "recording")[:most], read(args.reference, "reference")[:most]
    voice = read(str(DEMO / "human.flac"), "human")
    with progress("passport") as step:
        human = voice[speaking(voice)]
        found = measure(recording, reference, human, args.human_db, args.engine or ENGINES, step)
        named, verdict = (None, "not asked for") if args.no_diagnosis else _diagnosed(recording, reference, step)
    figures = found.to_dict() | {
        "diagnosis": named.to_dict() if named else None,
        "said": {**expectation(found), "diagnosis": verdict},
    }
    print_result(args, lines(found, verdict), figures)
    if html:
        html.write_page(args.report, html.passport_page(found, verdict, vars(args)))
        print_result(args, [f"report      {args.report}"])


def _diagnosed(recording: Samples, reference: Samples, step: Callable[[str], None]) -> tuple[Diagnosis | None, str]:
    """What the diagnosis names, without a profile, and in a sentence; or why it names nothing."""
    step("diagnosis")
    try:
        found = Recording(recording, reference).diagnose(progress=step)
    except SignalError as error:
        return None, f"not possible: {error}"
    return found, headline(found.verdict, [finding.name for finding in found.ranking], calibrated=False)
