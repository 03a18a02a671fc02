"""What a process costs, told alike on every system."""

import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from edgefilter.filter import timing


@pytest.mark.parametrize(("system", "unit"), [("linux", 1024), ("darwin", 1024**2), ("freebsd14", 1024)])
def test_peak_memory_is_not_a_thousand_times_too_much_where_the_system_counts_bytes(
    monkeypatch, tmp_path, system, unit
):
    counted = SimpleNamespace(RUSAGE_SELF=0, getrusage=lambda who: SimpleNamespace(ru_maxrss=75 * unit))
    monkeypatch.setattr(timing, "resource", counted)
    monkeypatch.setattr(timing, "STATUS", tmp_path / "not there")
    monkeypatch.setattr(sys, "platform", system)
    assert timing.peak_memory_mb() == 75.0


def test_peak_memory_is_this_process_own_and_not_that_of_the_one_which_started_it():
    """Linux counts the memory of a process that starts another one to the other one, too."""
    large = np.ones(40 * 2**20)
    code = "import numpy; from edgefilter.filter.timing import peak_memory_mb; print(peak_memory_mb())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 10 < float(done.stdout) < large.nbytes / 2**20 < timing.peak_memory_mb()


def test_peak_memory_is_the_most_that_there_was_and_not_what_there_is(monkeypatch, tmp_path):
    status = tmp_path / "status"
    status.write_text("VmPeak:\t  999999 kB\nVmHWM:\t   76800 kB\nVmRSS:\t   10240 kB\n")
    monkeypatch.setattr(timing, "STATUS", status)
    assert timing.peak_memory_mb() == 75.0
