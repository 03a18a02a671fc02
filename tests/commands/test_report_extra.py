"""Pictures and pages need the report extra.

Everything else goes without it, and what is missing is said before the work.
"""

import json
import subprocess
import sys

import pytest
import soundfile

from edgefilter.diagnosis.recording import compare
from edgefilter.report.html import comparison_page
from tests.diagnosis.robot_scene import profile, record, voice


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    x = voice(4.0)
    profile().save(folder / "robot.npz")
    soundfile.write(folder / "ref.wav", x, 16000, "FLOAT")
    soundfile.write(folder / "mic.wav", record(x, profile().echo), 16000, "FLOAT")
    return folder


def without(package, folder, *words):
    """The command line where a package is not installed."""
    code = (
        f"import sys; sys.modules[{package!r}] = None; from edgefilter.cli import main;"
        f" sys.exit(main({[str(word) for word in words]!r}))"
    )
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True)


FILES = ["--profile", "robot.npz", "--recording", "mic.wav", "--reference", "ref.wav"]


@pytest.mark.slow
def test_compare_and_diagnose_work_without_jinja2(scene):
    for command in ("compare", "diagnose"):
        done = without("jinja2", scene, command, *FILES)
        assert done.returncode == 0 and "over the noise floor" in done.stdout, done.stderr


@pytest.mark.parametrize(
    ("package", "words"),
    [
        ("jinja2", ["compare", "--recording", "missing.wav", "--reference", "ref.wav", "--report", "r.html"]),
        ("jinja2", ["diagnose", "--recording", "missing.wav", "--reference", "ref.wav", "--report", "r.html"]),
        ("matplotlib", ["profile", "show", "missing.npz", "--plot", "p.png"]),
    ],
)
def test_a_missing_package_is_said_in_one_line_before_anything_is_read(scene, package, words):
    done = without(package, scene, *words)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and done.stdout == ""
    assert package in done.stderr and "pip install matplotlib jinja2" in done.stderr


def test_names_of_files_and_effects_are_text_in_the_page_and_never_markup():
    x = voice(3.0)
    found = compare(profile(), record(x), x)
    page = comparison_page(found, {"profile": "<b>bold.npz", "recording": "a&b\"'.wav", "reference": "{{ 7 * 7 }}.wav"})
    assert (
        "<b>bold" not in page
        and "&lt;b&gt;bold.npz" in page
        and "a&amp;b&#34;&#39;.wav" in page
        and "{{ 7 * 7 }}.wav" in page
    )
    data = page.split('id="data">')[1].split("</script>")[0]
    assert "<" not in data and json.loads(data)["variants"][""]["excess_db"] == round(found.excess_db, 3)


def test_json_on_standard_output_is_json_alone_also_with_a_picture(scene, capsys):
    from edgefilter.cli import main

    assert main(["profile", "show", str(scene / "robot.npz"), "--json", "-", "--plot", str(scene / "p.png")]) == 0
    assert json.loads(capsys.readouterr().out)["schema"] == 1 and (scene / "p.png").stat().st_size > 1000
