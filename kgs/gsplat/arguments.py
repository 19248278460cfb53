"""The arguments of gsplat's call that kgs does not support, with the reason for each."""

from typing import Any

from kgs._support.errors import ArgumentError, quoted

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
LENSES = ("pinhole", "fisheye", "ortho")
RAY_DEPTH_MODES = ("d", "Ed", "RGB-d", "RGB-Ed")
_FROM_3D = "kgs renders footprints in the image, not Gaussians in space"
_LENS = "for distorted lenses use kgs.PosedCamera and kgs.GaussianRenderer"

# The unsupported arguments: the default, which changes nothing, and the reason why others are refused.
_UNSUPPORTED: dict[str, tuple[Any, str]] = {
    "sparse_grad": (False, "the gradients of kgs are dense"),
    "distributed": (False, "kgs renders in one process"),
    "with_ut": (False, "kgs linearises the lens at each centre"),
    "with_eval3d": (False, _FROM_3D),
    "global_z_order": (True, "kgs sorts by z"),
    "rays": (None, _FROM_3D),
    "radial_coeffs": (None, _LENS),
    "tangential_coeffs": (None, _LENS),
    "thin_prism_coeffs": (None, _LENS),
    "ftheta_coeffs": (None, _LENS),
    "lidar_coeffs": (None, _FROM_3D),
    "external_distortion_coeffs": (None, _LENS),
    "rolling_shutter": (None, "one pose per image"),
    "viewmats_rs": (None, "one pose per image"),
    "extra_signals_sh_degree": (None, "extra signals are taken as they are"),
}


def refuse(**given: Any) -> None:
    """Raise a ValueError for an unsupported argument that differs from its default."""
    for name, value in given.items():
        default, why = _UNSUPPORTED[name]
        if name == "rolling_shutter" and getattr(value, "name", None) == "GLOBAL":
            continue
        if hasattr(value, "shape"):
            raise ArgumentError(name, f"{default!r} ({why})", f"an array {tuple(value.shape)}")
        if value != default:
            raise ArgumentError(name, f"{default!r} ({why})", quoted(value))


def check_words(render_mode: str, rasterize_mode: str, camera_model: str) -> None:
    """Raise a ValueError for a word that gsplat does not have, or that kgs does not support."""
    if render_mode in RAY_DEPTH_MODES:
        raise ArgumentError("render_mode", f"one of {RENDER_MODES} ({_FROM_3D})", quoted(render_mode))
    words = {
        "render_mode": (render_mode, RENDER_MODES),
        "rasterize_mode": (rasterize_mode, ("classic", "antialiased")),
        "camera_model": (camera_model, LENSES),
    }
    for name, (word, known) in words.items():
        if word not in known:
            raise ArgumentError(name, f"one of {known}", quoted(word))
