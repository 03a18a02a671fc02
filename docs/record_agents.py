"""Runs the examples of agents and writes what they print into docs/agents_recorded.md.

Run from the root of the repository: python -m docs.record_agents WHISPER. Needs the extras pipecat, livekit and
wyoming, faster-whisper, and WHISPER, a model for it (a folder, or a name such as base).
"""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from subprocess import PIPE
from tempfile import TemporaryDirectory

EXAMPLES = Path(__file__).with_name("examples")
DEMO = Path(__file__).parents[1] / "edgefilter/demo_data"
PAGE = Path(__file__).with_name("agents_recorded.md")
AGENTS = {"agent_pipecat.py": "pipecat-ai", "agent_livekit.py": "livekit-agents", "agent_wyoming.py": "wyoming"}
HEAD = """# What the examples print

Written by `python -m docs.record_agents WHISPER`, with Whisper-base (faster-whisper {whisper}). In the three
conversations a simulated robot says 5.7 s into the [simulated room](examples/room.py), all of it handed over at once; a
recorded human, at the microphone 23 dB below it and 8 dB above its fan, says over it what Whisper writes of the human
alone as "Please leave your message after the tone, when done hang up, or press the pound key". One conversation each:
they show that it works, not how well.
"""


def main() -> None:
    """Run each example and write the page."""
    model = sys.argv[1]
    parts = [HEAD.format(whisper=version("faster-whisper"))]
    for name, package in AGENTS.items():
        title = f"## [{name}](examples/{name}), {package} {version(package)}"
        parts.append(f"{title}\n\n```text\n{output(name, model)}```\n")
    title = "## [listen.py](examples/listen.py) on the bundled recording, on which the robot talks on"
    with TemporaryDirectory() as folder:
        log = Path(folder) / "events.jsonl"
        options = ["--output", "-", "--quiet", "--no-learn", "--log-json", log]
        for option, name in (("input", "mic.flac"), ("reference", "reference.flac"), ("profile", "profile.npz")):
            options += [f"--{option}", DEMO / name]
        human = subprocess.run([sys.executable, "-m", "edgefilter.cli", "run", *options], stdout=PIPE, check=True)
        said = output("listen.py", log, model, stdin=human.stdout)
    parts.append(f"{title}\n\n```text\n{said}```\n")
    PAGE.write_text("\n".join(parts))


def output(name: str, *words: object, stdin: bytes = b"") -> str:
    """What an example prints."""
    command = [sys.executable, EXAMPLES / name, *map(str, words)]
    return subprocess.run(command, input=stdin, stdout=PIPE, check=True).stdout.decode()


if __name__ == "__main__":
    main()
