"""The folder of a fit: one fit at a time, an old result that stays whole until the new one is, and what is read again.

A fit writes to `unfinished`, its checkpoints included. When all is there the folder is renamed to `finished`, and its
files are moved to their places. Whoever opens the folder after a kill in between ends the move first.
"""

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from kgs.camera import move_camera
from kgs.datasets.scene import Scene
from kgs.errors import DataError
from kgs.json_files import read_json
from kgs.model import GaussianModel
from kgs.renderer import GaussianRenderer

from .checkpoint import is_number, newest_checkpoint, previous
from .config import FitConfig
from .outputs import EXPORTS, is_own, remove_others, write_json
from .poses import place_cameras

CHECKPOINT = "checkpoint.safetensors"
RESULTS = ("config.json", "metrics.json", "splat.ply", "curve.png", "index.html", *EXPORTS)
UNFINISHED, _FINISHED = "unfinished", "finished"
_LIST = "files.json"  # all files of the new result
_OPTIONAL = (previous(Path(CHECKPOINT)).name, "turntable.webm", "checkpoint.pt", "checkpoint.previous.pt")  # old


@contextmanager
def held(path: Path) -> Iterator[bool]:
    """Hold a file, made if it is not there, until the block or the process ends; False where another one has it."""
    with open(path, "ab") as file:
        ours = True
        try:
            if sys.platform == "win32":
                import msvcrt

                file.seek(2**30)  # behind its end: what is locked cannot be read
                msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
            else:
                import fcntl

                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            ours = False
        except OSError:
            pass  # a file system without locks
        yield ours


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Keep other fits out of a folder until the block or the process ends; DataError where one is at work there."""
    with held(out / ".lock") as ours:
        if not ours:
            raise DataError(out, "", "another fit is at work in this folder: wait for it or choose another --out")
        yield


def taken(out: Path) -> list[str]:
    """What a fit replaces or removes in its folder; checkpoints, which may be damaged, only where there is no fit."""
    names = [*RESULTS, UNFINISHED, _FINISHED]
    return names if is_own(out / "config.json") else [*names, CHECKPOINT, *_OPTIONAL]


def publish(out: Path) -> None:
    """Put the results in `unfinished` in the place of a former fit's; what fails to move, the next `end_move` moves."""
    new = out / UNFINISHED
    write_json(new / _LIST, {"files": _results(new)})
    shutil.rmtree(out / _FINISHED, ignore_errors=True)
    os.replace(new, out / _FINISHED)
    end_move(out)


def end_move(out: Path) -> None:
    """Within `locked`: what is left of a move goes to its place, what belonged to the former result goes away."""
    done = out / _FINISHED
    if not (is_own(done) and (done / _LIST).exists()):
        return
    names = [str(name) for name in read_json(done / _LIST).get("files", [])]  # of the moved ones as well
    (out / "test").mkdir(exist_ok=True)
    remove_others(out / "test", {Path(name).name for name in names if name.startswith("test/")})
    for name in set(_OPTIONAL) - set(names):
        (out / name).unlink(missing_ok=True)
    for name in _results(done):
        os.replace(done / name, out / name)
    shutil.rmtree(done)


def _results(folder: Path) -> list[str]:
    """The files of a result, without what a kill left half written."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != _LIST]
    return [path.relative_to(folder).as_posix() for path in files if path.name[0] != "." and path.suffix != ".partial"]


def is_finished(out: Path) -> bool:
    """Whether the folder has the results of a fit that did all its steps."""
    try:
        return bool(read_json(out / "metrics.json")["steps"] >= read_json(out / "config.json")["fit"]["steps"])
    except (DataError, KeyError, TypeError):
        return False


def read_settings(path: Path) -> tuple[dict[str, Any], FitConfig]:
    """The arguments of `load_scene` and the configuration in a fit's config.json; a DataError where it is wrong."""
    settings = read_json(path)
    for name in ("request", "fit"):
        if not isinstance(settings.get(name), dict):
            raise DataError(path, name, f"expected an object, got {str(settings.get(name, 'none'))[:60]!r}")
    request = {"points": "none", "hold_out": None, **settings["request"]}  # what older folders do not say
    for name, expected, is_right in (
        ("scene", "a path", lambda v: isinstance(v, str) and v and "\0" not in v),
        ("train_views", "a whole number above 0 or null", lambda v: v is None or is_number(v, 1, whole=True)),
        ("downscale", "a number of at least 1 or null", lambda v: v is None or is_number(v, 1)),
        (
            "hold_out",
            "0, a whole number above 1 or null",
            lambda v: v is None or (is_number(v, 0, whole=True) and v != 1),
        ),
        ("background", "one of ['black', 'white']", lambda v: v in ("black", "white")),
        ("points", "one of ['none', 'model-points']", lambda v: v in ("none", "model-points")),
    ):
        if name not in request or not is_right(request[name]):
            got = f"{request[name]!r}"[:60] if name in request else "none"
            raise DataError(path, f"request.{name}", f"expected {expected}, got {got}")
    try:
        return request, FitConfig.from_dict(settings["fit"])
    except ValueError as error:
        raise DataError(path, "fit", str(error)) from error


class SavedFit(NamedTuple):
    """A fit for pictures and measures, without what training needs."""

    request: dict[str, Any]  # the arguments of `load_scene`
    config: FitConfig
    model: GaussianModel  # in the frame of the scene: world coordinates less `Scene.offset`
    near_plane: float  # in world units
    step: int  # steps that are done
    backend: str  # of the fit; on a GPU "auto"
    poses: Tensor | None  # `(V, 4, 4)` of the training cameras, where the fit moved them

    def placed(self, scene: Scene) -> Scene:
        """The fit's scene, with the training cameras where the fit has them."""
        return scene if self.poses is None else place_cameras(scene, self.poses)

    @torch.no_grad()
    def render(self, camera: PinholeCamera, background: Tensor) -> Tensor:
        """All Gaussians from one camera over the scene's background `(3,)`, `(1, 3, H, W)`; on the model's device."""
        device, most = self.model.means.device, self.config.max_bytes
        renderer = GaussianRenderer(near_plane=self.near_plane, max_bytes=most, backend=self.backend).eval()
        image: Tensor = renderer(self.model(), move_camera(camera, device), background.to(device)).image
        return image


def load_fit(out: Path, device: torch.device | str = "cpu") -> SavedFit:
    """Read what a fit left in its folder; a DataError where config.json or the checkpoint is missing or damaged."""
    if (out / _FINISHED / _LIST).exists():  # a kill stopped the move
        with locked(out):
            end_move(out)
    request, config = read_settings(out / "config.json")
    path = out / CHECKPOINT
    state, _ = newest_checkpoint(path)
    try:
        model = GaussianModel(**state["model"])
        model = (model.select(**part) if (part := state.get("shown")) else model).to(device)
        backend = str(state.get("backend", "torch")) if model.means.device.type == "cpu" else "auto"
        poses = (state.get("poses") or {}).get("extrinsics")
        return SavedFit(request, config, model, float(state["near_plane"]), int(state["step"]), backend, poses)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(path, "model", f"expected the Gaussians of a fit, got {error}") from error
