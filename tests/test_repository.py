"""What the repository may hold: no file that its history would carry for ever, no result of a commit that is nowhere."""

import re
import subprocess

from tests.program import ROOT

MOST_MB = 4.5
"""The largest file, models/crnn.onnx, has 4.2 MB."""


def test_no_file_of_the_repository_is_larger_than_four_and_a_half_megabytes():
    """In a checkout the tracked files and those about to be added; in an unpacked archive every file."""
    command = ["git", "-C", ROOT, "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = (
        subprocess.run(command, capture_output=True, text=True).stdout.split("\0") if (ROOT / ".git").exists() else []
    )
    files = [ROOT / name for name in listed if name] or list((ROOT / "models").rglob("*"))
    large = {str(path.relative_to(ROOT)): path.stat().st_size for path in files if path.is_file()}
    assert "models/crnn.onnx" in large, "no files were found"
    assert not {name: size for name, size in large.items() if size > MOST_MB * 1e6}


def test_each_result_names_a_commit_that_is_there():
    """In a checkout with its history; an unpacked archive and a shallow clone can only tell that a commit is named."""
    git = ["git", "-C", ROOT]
    shallow = subprocess.run([*git, "rev-parse", "--is-shallow-repository"], capture_output=True, text=True).stdout
    results = sorted((ROOT / "bench" / "results").glob("*.json"))
    named = {path.name: re.findall(r'"commit": "(.*?)"', path.read_text(encoding="utf-8")) for path in results}
    assert named and all(re.fullmatch("[0-9a-f]{40}", commit) for found in named.values() for commit in found or [""])
    if (ROOT / ".git").exists() and shallow.strip() == "false":
        for commit in {commit for found in named.values() for commit in found}:
            subprocess.run([*git, "cat-file", "-e", f"{commit}^{{commit}}"], check=True)
