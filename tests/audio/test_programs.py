"""What programs play on one output of the sound server is lowered and raised again, and nothing else."""

import stat

import pytest

from edgefilter.audio.pulse import Programs, streams_on

SERVER = """#!/bin/sh
case "$*" in
'list short sinks') printf '0\\trobot\\tmodule\\n1\\tmusic\\tmodule\\n' ;;
'list short sink-inputs') printf '7\\t0\\t1\\n8\\t1\\t2\\n9\\t0\\t3\\n' ;;
'get-sink-volume robot') {volume} ;;
'set-sink-input-volume 9 '*) echo "$*" >> {log}; echo 'Failure: No such entity' >&2; exit 1 ;;
set-*) echo "$*" >> {log} ;;
*) exit 1 ;;
esac
"""


@pytest.fixture
def serve(tmp_path, monkeypatch):
    """A function that sets up a sound server with three streams, of which the last has just ended; gives what it was told to do."""

    def start(volume="echo 65536"):
        program, log = tmp_path / "pactl", tmp_path / "log"
        program.write_text(SERVER.format(volume=volume, log=log))
        program.chmod(program.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
        return lambda: [line.split(maxsplit=1)[1] for line in log.read_text().splitlines()]

    return start


def test_all_streams_of_the_output_are_lowered_once_and_raised_by_as_much(serve):
    told, refused = serve(), []
    with Programs("robot", refused.append) as programs:
        programs.fade(0.25)
        programs.fade(1.0)
        programs.fade(0.5)
        programs.fade(1.0)
    assert told() == [f"7 {db}dB" if stream == 7 else f"9 {db}dB" for db, stream in [
        ("-12.04", 7), ("-12.04", 9), ("+12.04", 7), ("-6.02", 7), ("-6.02", 9), ("+6.02", 7),
    ]]  # fmt: skip
    assert refused == []


def test_another_gain_is_reached_from_the_volume_that_was_found_and_the_end_of_the_run_leaves_that(serve):
    told = serve()
    with Programs("robot", print) as programs:
        programs.fade(0.25)
        programs.fade(0.5)
    assert [each for each in told() if each.startswith("7")] == ["7 -12.04dB", "7 +12.04dB", "7 -6.02dB", "7 +6.02dB"]


def test_with_flat_volumes_one_line_says_what_to_set_and_nothing_stays_lowered(serve, tmp_path):
    told, refused = serve(f"wc -c < {tmp_path}/log 2>/dev/null || echo 0"), []
    with Programs("robot", refused.append) as programs:
        for gain in (0.25, 1.0, 0.25):
            programs.fade(gain)
    assert [each for each in told() if each.startswith("7")] == ["7 -12.04dB", "7 +12.04dB"]
    assert len(refused) == 1 and "flat-volumes = no" in refused[0]


def test_without_a_server_nothing_is_lowered_and_nothing_is_said(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    refused = []
    with Programs("robot", refused.append) as programs:
        programs.fade(0.25)
    assert refused == [] and streams_on("robot") == []
