"""What a newcomer reads: the help of each command, and what is said of a scene that cannot be fitted."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_scenes import write_colmap, write_photos

from kgs.app.cli import main
from kgs.app.cli.run import _COMMANDS


@pytest.mark.parametrize("command", _COMMANDS)
def test_help_says_in_words_what_an_option_does_unless_given(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    if command == "study":
        pytest.importorskip("pandas")
    with pytest.raises(SystemExit) as stop:
        main([*command.split(), "--help"])
    text = capsys.readouterr().out
    assert stop.value.code == 0
    assert "For example:" in text
    assert "None" not in text
    described = [line.strip("│ ") for line in text.splitlines() if line.startswith("│")]
    assert not [line for line in described if "--no-" in line and "(default: True)" in line]


def test_a_scene_whose_photos_are_too_small_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = tmp_path / "scene"
    write_photos(scene / "images")
    write_colmap(scene)
    with pytest.raises(SystemExit) as stop:
        main(["fit", str(scene), "-o", str(tmp_path / "out")])
    assert stop.value.code == 2
    assert f"{scene}: images: expected at least 32 pixels" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
