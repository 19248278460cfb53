"""The benchmark of speed measures what it says; how fast anything is, is no test."""

import csv
import subprocess
import time

import pytest
import torch
from kornia.geometry.camera import PinholeCamera

import kgs
from kgs.bench import speed
from kgs.bench.scenes import layered_scene
from kgs.bench.speed import Cases
from kgs.bench.timing import busy_processes, take_turns, time_parts


def test_the_scene_keeps_its_footprints_and_pairs_per_gaussian():
    sizes = []
    for count, size in ((2000, (94, 126)), (2000, (189, 252)), (8000, (189, 252))):
        model, camera = layered_scene(count, size)
        assert isinstance(camera, PinholeCamera)
        projected = kgs.project(model(), camera)
        xx, _, yy, det = kgs.geometry.covariance.variances(projected.factors, 0.3)
        sizes.append(float(det.detach().pow(0.25).median()))
        inside = (projected.means2d > -0.5) & (projected.means2d < torch.tensor(size).flip(0) - 0.5)
        assert 0.7 < int(inside.all(1).sum()) / count < 0.82
        assert bool((xx > 0).all() and (yy > 0).all())
    assert max(sizes) / min(sizes) < 1.1
    assert sizes[0] == pytest.approx(2.3, abs=0.3)


def test_the_same_seed_gives_the_same_scene():
    one, other = layered_scene(50)[0].state_dict(), layered_scene(50)[0].state_dict()
    assert all(torch.equal(one[name], other[name]) for name in one)
    assert not torch.equal(layered_scene(50, seed=1)[0].means, one["means"])


def test_cases_take_turns():
    order = []
    times = take_turns({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, repeats=3)
    assert order == ["a", "b"] * 4
    assert times["a"].best <= times["a"].wall <= times["a"].worst


def test_parts_are_timed_from_one_to_the_next():
    def run():
        yield "a"
        time.sleep(0.02)
        yield "b"

    times = time_parts(run, repeats=2)
    assert times["a"].best < 0.02 <= times["b"].best


def test_stages_are_those_of_a_whole_step():
    cases = Cases(300, (40, 56), torch.device("cpu"))
    renderer = kgs.GaussianRenderer()
    image = renderer(cases.model(), cases.camera).image
    kgs.losses.photometric_loss(image.clamp(0, 1), cases.photo, 0.2).backward()
    expected = {name: parameter.grad.clone() for name, parameter in cases.model.named_parameters()}
    cases.model.zero_grad()
    for name in cases.stages():
        if name == "projection, harmonics, backward":  # before Adam takes the gradients
            break
    for name, parameter in cases.model.named_parameters():
        torch.testing.assert_close(parameter.grad, expected[name], rtol=1e-4, atol=1e-5 * expected[name].abs().max())


@pytest.mark.slow
def test_the_files_are_written(tmp_path, monkeypatch):
    monkeypatch.setattr(speed, "SIZE", (36, 48))
    monkeypatch.setattr(speed, "_memory_of_its_own", lambda *_: 1.0)
    speed.speed(out=tmp_path / "new", quick=True)
    names = {path.name for path in (tmp_path / "new").iterdir()}
    assert names == {"speed.csv", "speed.md", "scaling.png"}
    with (tmp_path / "new" / "speed.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["table"] for row in rows} == {"main", "busy", "stages", "left out", "scaling"}
    main = [row for row in rows if row["table"] == "main"]
    assert {row["case"] for row in main} > set(speed.TARGETS) - {"peak memory", "busy"}
    assert {row["backend"] for row in main} == set(speed.backends(torch.device("cpu")))
    page = (tmp_path / "new" / "speed.md").read_text()
    assert "| forward + backward, torch |" in page
    assert "| forward + backward, torch, wall beside two busy processes over that |" in page


@pytest.mark.slow
def test_memory_is_measured_in_a_process_of_its_own():
    assert 5 < speed._memory_of_its_own(300, "torch") < 500


def test_busy_processes_end_with_the_block(monkeypatch):
    started, plain = [], subprocess.Popen

    def start(*args, **options):
        started.append(plain(*args, **options))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", start)
    with busy_processes(2):
        assert [process.poll() for process in started] == [None, None]
    assert None not in [process.poll() for process in started]
