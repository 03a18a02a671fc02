"""The words of a command of the diagnosis on a scene's files, and how it fails."""

from edgefilter.cli import main


def arguments(scene, command, *more, mic="mic.wav", ref="ref.wav", profile="robot.npz"):
    words = ["--profile", scene / profile, "--recording", scene / mic, "--reference", scene / ref]
    return [str(word) for word in (*command.split(), *words, *more)]


def fails_in_one_line(capsys, words, code, expected):
    capsys.readouterr()
    assert main([str(word) for word in words]) == code
    lines = capsys.readouterr().err.strip().splitlines()
    told = [line for line in lines if line.startswith("edgefilter: ")]
    assert len(told) == 1 and "Traceback" not in "".join(lines)
    for part in expected:
        assert part in told[0], told[0]
