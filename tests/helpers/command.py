"""The command `kgs` in this process, as a user types it."""

import pytest

from kgs.app import cli


def run(*arguments: object) -> int:
    """The exit code of `kgs` with these words."""
    with pytest.raises(SystemExit) as stop:
        cli.main([str(argument) for argument in arguments])
    assert isinstance(stop.value.code, int)
    return stop.value.code


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line of an error."""
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("kgs: ")
    return lines[0]
