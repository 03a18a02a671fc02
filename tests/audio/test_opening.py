"""What opening a stream changes for the whole process, it changes for one stream at a time and puts back."""

import os
import subprocess
import sys
import threading

import pytest

from edgefilter.audio.pulse import leading_to


@pytest.mark.parametrize("before", [None, "the_users_own"])
def test_two_streams_opened_at_once_read_each_its_own_source_and_leave_the_environment_as_it_was(monkeypatch, before):
    monkeypatch.delenv("PULSE_SOURCE", raising=False)
    if before:
        monkeypatch.setenv("PULSE_SOURCE", before)
    start, inside, seen = threading.Barrier(2), threading.Event(), {}

    def open_stream(source):
        start.wait(5)
        with leading_to(source, "input"):
            inside.wait(0.2)  # where the other were let in meanwhile, it would now have set its own
            seen[source] = os.environ["PULSE_SOURCE"]

    threads = [threading.Thread(target=open_stream, args=(source,)) for source in ("mic", "robot.monitor")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(5)
    assert seen == {"mic": "mic", "robot.monitor": "robot.monitor"}
    assert os.environ.get("PULSE_SOURCE") == before


def test_an_output_has_a_variable_of_its_own(monkeypatch):
    monkeypatch.delenv("PULSE_SINK", raising=False)
    with leading_to("edgefilter_human", "output"):
        assert os.environ["PULSE_SINK"] == "edgefilter_human" and "PULSE_SOURCE" not in os.environ
    assert "PULSE_SINK" not in os.environ


def test_a_device_that_needs_no_source_leaves_the_environment_alone(monkeypatch):
    monkeypatch.setenv("PULSE_SOURCE", "the_users_own")
    with leading_to("", "input"):
        assert os.environ["PULSE_SOURCE"] == "the_users_own"


def test_two_streams_opened_at_once_do_not_silence_standard_error_for_good():
    code = (
        "import os, threading\n"
        "from edgefilter.audio.port import quiet\n"
        "first_in, second_in = threading.Event(), threading.Event()\n"
        "def first():\n"
        "    with quiet():\n"
        "        first_in.set(); second_in.wait(0.3)\n"
        "def second():\n"
        "    first_in.wait(5)\n"
        "    with quiet():\n"
        "        second_in.set(); one.join(0.3)\n"
        "one, two = threading.Thread(target=first), threading.Thread(target=second)\n"
        "one.start(); two.start(); one.join(); two.join()\n"
        "os.write(2, b'still heard')"
    )
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stderr == "still heard"
    )
