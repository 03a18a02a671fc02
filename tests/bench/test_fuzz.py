"""The fuzzer itself: every loader has files to start from, a few damaged ones of each are refused or taken, and a find is one."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import pytest

from bench import __main__ as bench
from bench import fuzz
from bench.fuzz import clients
from bench.fuzz.targets import TARGETS
from edgefilter.errors import UsageError

INPUTS = 12


def run(output: Path, *arguments: object, part: str = "fuzz") -> tuple[int, dict]:
    """The exit code, and what was written."""
    code = bench.main(["fuzz", "--output", str(output), *map(str, arguments)])
    return code, json.loads(output.with_suffix(".json").read_text())["parts"][part]


@pytest.mark.slow
@pytest.mark.parametrize("loader", [target.name for target in TARGETS])
def test_a_few_damaged_files_of_each_loader_keep_every_promise(loader: str, tmp_path: Path) -> None:
    code, found = run(tmp_path / "fuzz", "--inputs", INPUTS, "--only", loader)
    assert code == 0 and found["finds"] == []
    assert sum(found["loaders"][loader].values()) == INPUTS == found["inputs"]


def test_an_input_is_refused_in_one_line_or_a_find(tmp_path: Path) -> None:
    def refuses(text: str) -> fuzz.Target:
        def attempt(path: Path, rng: object) -> None:
            raise (ZeroDivisionError(text) if text == "by zero" else UsageError(text))

        return fuzz.Target("x", 1, ".x", list, lambda data, rng: data, attempt)

    said = [
        fuzz.attempt(refuses(text), tmp_path, fuzz.generator(0, 0)) for text in ("no", "x" * fuzz.LONGEST, "by zero")
    ]
    assert (
        said[0] == "refused"
        and said[1].startswith("no single line")
        and said[2].startswith("ZeroDivisionError: by zero (")
    )


def die(work: fuzz.Work) -> None:
    """A loading process that ends at its second input."""
    work.number.value = work.start
    if work.start == 0:
        os._exit(11)
    work.number.value = work.end - 1


@pytest.mark.slow
def test_where_a_process_dies_is_a_find_and_another_goes_on_behind_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(fuzz, "load_all", die)
    code, found = run(tmp_path / "fuzz", "--inputs", 3)
    assert code == 1 and capsys.readouterr().err == "bench fuzz: 1 finds in 3 files, the process died (11) first\n"
    assert [(find["number"], find["what"]) for find in found["finds"]] == [(0, "the process died (11)")]


@pytest.mark.slow
def test_hostile_clients_leave_both_services_and_their_other_clients_as_they_were(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clients, "LATE", 1e6)  # how fast answers come depends on what else the machine does
    monkeypatch.setattr(clients, "PART_S", 3.0)
    code, found = run(tmp_path / "fuzz", "--clients", "--minutes", 0.2, part="clients")
    assert code == 0 and found["finds"] == [] and found["attacks"] > clients.ATTACKERS
    (_, attacked, *_), (_, alone, *_), _ = found["rows"]
    assert min(alone, attacked) > 100


def test_an_attack_is_made_again_from_its_number_and_reaches_the_sound_in_all_forms() -> None:
    for make in (clients.websocket, clients.wyoming):
        made = [make(fuzz.generator(1, number)) for number in range(30)]
        assert made[7] == make(fuzz.generator(1, 7)) and len(set(made)) == 30
    assert len({len(clients.frame(2, bytes(size))) - size for size in (125, 126, 1 << 16)}) == 3


def test_a_service_that_dies_writes_a_traceback_or_takes_memory_is_a_find(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clients, "MOST_MB", 50)
    (port,) = clients.free_ports(1)
    listens = f"import socket, sys, time; s = socket.create_server(('127.0.0.1', {port}))\n"
    for deed, words in (
        ("sys.stderr.write('Traceback: x\\n'); sys.stderr.flush()", "wrote 'Traceback: x'"),
        ("sys.stderr.write('\\x1b[2J\\n'); sys.stderr.flush()", "wrote"),
        (f"held = b'1' * {100_000_000}", "MB, "),
        ("sys.exit(3)", "died (3)"),
    ):
        watched = clients.Watched(
            "it", ["-c", f"{listens}s.accept(); s.close(); time.sleep(0.5); {deed}; time.sleep(60)"], port
        )
        try:
            until = time.monotonic() + 20
            while not (wrong := watched.wrong()) and time.monotonic() < until:
                time.sleep(0.05)
            assert words in wrong
        finally:
            watched.process.kill()
            watched.process.wait()
