"""Checkpoints: safetensors files, written whole or not at all and verified on loading; the last two are kept.

The tensors of a nested dict are stored under their keys joined by "/". Everything else is JSON in the file's metadata
under "state", next to the format and the SHA-256 of tensors and JSON. Loading makes only tensors and plain values.
"""

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial, reduce
from operator import getitem
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from kgs.datasets.scene import Scene, Views
from kgs.errors import DataError
from kgs.io.ownership import MADE_BY
from kgs.io.results_folder import previous
from kgs.json_files import is_number, parse_json

from .config import FitConfig, timetable

_FORMAT = f"checkpoint 4, {MADE_BY}"


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write nested dicts, with text as keys, of tensors and JSON values; the file at `path` becomes the previous one.

    Whenever the process dies, `newest_checkpoint` finds the old or the new state; after an OSError both files are as
    they were. Any other value is a TypeError, and a plain number that is not finite a ValueError.
    """
    tensors: dict[str, Tensor] = {}
    text = json.dumps(_take_tensors(state, tensors), allow_nan=False, separators=(",", ":"))
    metadata = {"format": _FORMAT, "state": text, "sha256": _digest_all(text, tensors)}
    content = safetensors.torch.save(tensors, metadata)
    temporary = path.with_name(path.name + ".partial")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            os.replace(path, previous(path))
        os.replace(temporary, path)
        if os.name == "posix":  # the new names survive a power cut, where the file system can promise that
            descriptor = os.open(path.parent, os.O_RDONLY)
            try:
                with suppress(OSError):
                    os.fsync(descriptor)
            finally:
                os.close(descriptor)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)


def newest_checkpoint(path: Path) -> tuple[dict[str, Any], str]:
    """The state at `path`, or else in the previous file; and what is wrong with the file at `path`, or "".

    If neither can be read the DataError is about the file at `path`.
    """
    try:
        return load_checkpoint(path), ""
    except DataError as error:
        try:
            return load_checkpoint(previous(path)), str(error)
        except DataError:
            raise error from None


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read what `save_checkpoint` wrote, with tensors on the CPU.

    A DataError if the file is missing, damaged or not a checkpoint, or if a number is not finite.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DataError(path, "", f"expected a checkpoint, got {error.strerror}") from error
    try:
        tensors = safetensors.torch.load(content)
        metadata = parse_json(content[8 : 8 + int.from_bytes(content[:8], "little")])["__metadata__"]
        if metadata["format"] != _FORMAT:
            raise ValueError(f"expected the format {_FORMAT!r}, got {metadata['format']!r}")
        if metadata["sha256"] != _digest_all(metadata["state"], tensors):
            raise ValueError("expected the checksum of the content, got another: the file is damaged")
        state = parse_json(metadata["state"].encode())
        for name, tensor in tensors.items():
            if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
                raise ValueError(f"{name}: expected finite numbers, got NaN or infinity")
            *folders, key = name.split("/")
            reduce(getitem, folders, state)[key] = tensor.clone()
    except KeyError as error:
        raise DataError(path, str(error.args[0]), "expected this entry in a checkpoint of kgs, got none") from error
    except (safetensors.SafetensorError, TypeError, ValueError) as error:
        raise DataError(path, "", f"is not a whole checkpoint of kgs ({error})") from error
    if not isinstance(state, dict):
        raise DataError(path, "state", f"expected a dict, got a {type(state).__name__}")
    return state


def fingerprint(scene: Scene) -> dict[str, Any]:
    """SHA-256 sums of photos, masks, poses, intrinsics and background, to notice any change and to name it."""

    def of(views: Views) -> dict[str, Any]:
        tensors = {"photos": views.images, "masks": views.masks}
        tensors |= {"poses": views.cameras.extrinsics, "intrinsics": views.cameras.intrinsics}
        sums = {what: None if values is None else list(map(_digest, values)) for what, values in tensors.items()}
        return {"names": list(views.names), **sums}

    return {"training": of(scene.train), "test": of(scene.test), "background": _digest(scene.background)}


def check_state(state: dict[str, Any], scene: dict[str, Any], config: FitConfig) -> list[str]:
    """Raise KeyError, TypeError or ValueError unless a state has this fingerprint and configuration.

    Returns notes for the user, if a finished fit goes on for more steps.
    """
    steps, done, notes = state["config"]["steps"], state["step"], list[str]()
    wanted = timetable(config).steps
    asked = config.to_dict() | {"device": state["config"].get("device")}  # a fit may continue on another device
    asked |= {"backend": state["backend"]} if config.backend == "auto" else {}
    if steps == done < wanted:
        asked["steps"] = steps
        notes.append(
            f"trained on from step {done}, the end of a fit of {steps} steps: from here on learning rates, drop rate, "
            f"densification and resets are those of {wanted} steps, so that the result differs from a fit of "
            f"{wanted} steps from the start"
        )
    elif steps != wanted or done > steps:
        expected = f"{steps}, as the fit was begun with," if done < steps else f"at least the {done} that are done,"
        raise ValueError(f"steps: expected {expected} got {wanted}")
    _compare_settings(state["config"] | {"backend": state["backend"]}, asked)
    for part in ("training", "test"):
        for what, values in scene[part].items():
            before = state["scene"][part][what]
            if before != values:
                both = zip(scene[part]["names"], before or [], values or [], strict=False)
                changed = ", ".join(name for name, one, other in both if one != other)
                fault = f"{what} of the {part} views: expected those that the fit was begun with, got others"
                raise ValueError(f"{fault} for {changed:.200}" if changed else fault)
    if state["scene"]["background"] != scene["background"]:
        raise ValueError("background: expected the one that the fit was begun with, got another")
    if max(state["stack"], default=0) >= len(scene["training"]["names"]):
        raise ValueError(f"stack: expected views of the scene, got {state['stack']!s:.80}")
    return notes


def check_plain(state: dict[str, Any], *names: str) -> None:
    """Raise KeyError or ValueError if one of these plain values of a state is missing or wrong."""
    for name in names:
        expected, is_right = PLAIN[name]
        if not is_right(state[name]):
            raise ValueError(f"{name}: expected {expected}, got {str(state[name])[:80]!r}")


def _compare_settings(saved: dict[str, Any], asked: dict[str, Any], path: str = "") -> None:
    for name, value in asked.items():
        before = saved.get(name)
        if isinstance(value, dict) and isinstance(before, dict):
            _compare_settings(before, value, f"{path}{name}.")
        elif before != value:
            raise ValueError(f"{path}{name}: expected {before!r}, as the fit was begun with, got {value!r}")


def moments_of(optimizer: torch.optim.Optimizer) -> dict[str, dict[str, Tensor]]:
    """Adam's step and moments of each parameter group, by its name; an empty dict if it had no gradient yet."""
    return {group["name"]: optimizer.state.get(group["params"][0], {}) for group in optimizer.param_groups}


def load_moments(optimizer: torch.optim.Optimizer, moments: dict[str, Any]) -> None:
    """The inverse of `moments_of`; a ValueError if shapes or signs are wrong, which torch does not check."""
    groups, found = optimizer.state_dict()["param_groups"], {}
    for group, held in zip(groups, optimizer.param_groups, strict=True):
        shape, state = held["params"][0].shape, moments[group["name"]]
        if state:
            shapes = {"step": (), "exp_avg": shape, "exp_avg_sq": shape}
            negative = any(bool((state[name] < 0).any()) for name in ("step", "exp_avg_sq"))
            if negative or {name: tuple(value.shape) for name, value in state.items()} != shapes:
                raise ValueError(f"optimizer: expected a step and two moments like {group['name']}, got others")
            found[group["params"][0]] = state
    optimizer.load_state_dict({"state": found, "param_groups": groups})


def _digest(tensor: Tensor) -> str:
    """SHA-256 of the type, shape and numbers of a tensor, in hexadecimal digits."""
    checksum = hashlib.sha256(f"{tensor.dtype} {tuple(tensor.shape)} ".encode())
    checksum.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return checksum.hexdigest()


def _digest_all(text: str, tensors: Mapping[str, Tensor]) -> str:
    parts = [text, *(f"{name} {_digest(tensors[name])}" for name in sorted(tensors))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _take_tensors(value: Any, tensors: dict[str, Tensor], path: str = "") -> Any:
    """The value without its tensors, which are added to `tensors` under their path."""
    if not isinstance(value, dict):
        return value
    rest = {}
    for key, item in value.items():
        if not isinstance(key, str) or "/" in key:
            raise TypeError(f"state: expected text without '/' as keys, got {key!r}")
        if isinstance(item, Tensor):
            tensors[path + key] = item.detach().to("cpu", copy=True).contiguous()  # safetensors refuses shared memory
        else:
            rest[key] = _take_tensors(item, tensors, f"{path}{key}/")
    return rest


_is_count = partial(is_number, least=0, whole=True)


def _is_list(value: Any, is_right: Callable[[Any], bool]) -> bool:
    return isinstance(value, list) and all(map(is_right, value))


def _is_point(value: Any) -> bool:
    keys = {"step", "seconds", "test_psnr", "train_psnr"}
    return value.keys() == keys and all(x is None or is_number(x) for x in value.values())


# The plain values of a fit's state: what is expected of each in words, and the check.
PLAIN: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "backend": ("one of ['torch', 'numba', 'triton']", lambda v: v in ("torch", "numba", "triton")),
    "init": ("kind and number of initial points", lambda v: v.keys() == {"kind", "points"} and _is_count(v["points"])),
    "step": ("a number of steps", _is_count),
    "seconds": ("a number, not negative", lambda v: is_number(v, 0)),
    "curve": ("a list of measurements", lambda v: _is_list(v, _is_point)),
    "notes": ("a list of texts", lambda v: _is_list(v, lambda x: isinstance(x, str))),
    "needs": ("what was decided", lambda v: isinstance(v, dict)),
    "extent": ("a number above 0", lambda v: is_number(v, 1e-300)),
    "near_plane": ("a number above 0", lambda v: is_number(v, 1e-300)),
    "stack": ("a list of views", lambda v: _is_list(v, _is_count)),
}
