"""Writes a fit for other programs, besides its PLY file: cameras, compressed PLY, glTF, a film, a still."""

from dataclasses import replace
from pathlib import Path

from kgs._support.json_files import write_json
from kgs.app.console import each
from kgs.app.files.cameras import camera_list, shown, shown_poses, upright
from kgs.app.files.encoders import film_suffix
from kgs.app.files.film import path_near_plane, write_film
from kgs.app.files.glb import save_glb
from kgs.app.files.preview import write_preview
from kgs.app.files.reach import film_views
from kgs.compressed_ply import save_compressed_ply
from kgs.fit.fit import Fit
from kgs.geometry.multiview import typical_depths
from kgs.ply import float32_moves


def write_exports(fit: Fit, folder: Path, roll: float = 0.0) -> list[str]:
    """Write `fit_files.EXPORTS` with one of the films; returns notes that say why there is none.

    `roll` turns the pictures of the film, and with them what is up in the glTF file, see
    :func:`kgs.app.files.cameras.rolled`.
    """
    scene = fit.scene
    write_splat_exports(fit, folder, roll)
    depth = typical_depths(fit.model.means, scene.train.cameras)[1]
    near_plane = path_near_plane(fit.model.means, scene.train.cameras, fit.options.near_plane)
    film_fit = replace(fit, options=replace(fit.options, near_plane=near_plane))
    frames, best = film_views(fit, roll)
    write_preview(folder / "preview.jpg", film_fit, frames, best)
    why = write_film(folder / f"turntable{film_suffix()}", film_fit.render, frames, depth, each)
    return [why] if why else []


def write_splat_exports(fit: Fit, folder: Path, roll: float = 0.0) -> None:
    """Write cameras.json, splat.glb and splat.compressed.ply; `roll` as in :func:`write_exports`.

    Without Gaussians there is no compressed PLY. In map coordinates its origin is that of the scene, see
    :func:`kgs.ply.float32_moves`.
    """
    scene = fit.scene
    listed = camera_list([*shown(scene.train), *shown(scene.test)], scene.offset, fit.model.means)
    write_json(folder / "cameras.json", listed)
    save_glb(folder / "splat.glb", fit.model, upright(shown_poses(scene.train, roll)), scene.offset)
    if len(fit.model):
        means = fit.model.means.detach().cpu().double() + scene.offset
        moves = float32_moves(means.numpy(), fit.model.log_scales.detach().cpu().numpy())
        save_compressed_ply(folder / "splat.compressed.ply", fit.model, None if moves else scene.offset)
