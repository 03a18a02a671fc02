"""Tasks over processes and over a Dask cluster: the same answers, and what happens where one is missing."""

import json

import numpy as np
import pytest
from distributed import LocalCluster

from bench.spread import spread
from edgefilter.errors import UsageError
from export import dataset
from tests.export.speech import write_librispeech, write_table


@pytest.fixture(scope="module")
def cluster():
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster


def power(shared, task):
    if task == 13:
        raise UsageError("an unlucky number")
    return task**shared


@pytest.mark.slow
def test_processes_and_cluster_answer_the_same(cluster):
    tasks = list(range(12))
    assert set(spread(power, 3, tasks, 2)) == set(spread(power, 3, tasks, 1, cluster.scheduler_address))


def test_a_task_that_fails_and_a_scheduler_that_is_not_there_are_said(cluster, monkeypatch):
    monkeypatch.setattr("bench.spread.PATIENCE", "1s")
    for scheduler in (None, cluster.scheduler_address):
        with pytest.raises(UsageError, match="unlucky"):
            list(spread(power, 2, [13], 1, scheduler))
    with pytest.raises(UsageError, match="no Dask scheduler answers"):
        list(spread(power, 2, [1], 1, "tcp://127.0.0.1:1"))


@pytest.mark.slow
def test_a_cluster_simulates_the_same_items(cluster, tmp_path, capsys):
    humans, robots = write_librispeech(tmp_path / "humans", ("1", "2")), write_table(tmp_path / "robots", ("a",))
    shape = ["--count", "2", "--seed", "4", "--rooms", "3", "--jobs", "1"]
    folders = {"here": [], "there": ["--scheduler", cluster.scheduler_address]}
    for name, more in folders.items():
        given = ["--humans", humans, "--robots", robots, "--output", tmp_path / name, *shape, *more]
        assert dataset.main([*map(str, given)]) == 0
    for number in range(2):
        ours, theirs = (np.load(tmp_path / name / f"{number:05d}.npz") for name in folders)
        assert json.loads(str(ours["about"])) == json.loads(str(theirs["about"]))
        assert all(np.array_equal(ours[part], theirs[part]) for part in ours)


def test_a_folder_without_speech_is_one_line(tmp_path, capsys):
    given = ["--humans", str(tmp_path), "--robots", str(tmp_path), "--output", str(tmp_path / "out")]
    assert dataset.main(given) == 1
    assert "holds no speech" in capsys.readouterr().err.strip().splitlines()[-1]
