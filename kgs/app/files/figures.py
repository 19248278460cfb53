"""Figures of a fit: renders beside their photos, and the training curve."""

from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from kgs._support.json_files import write_whole
from kgs.datasets.scene import Views

from .images import eight_bits
from .plot import psnr_plot

# One colour for each method in all figures and pages: those of Okabe and Ito, which colour-blind people tell apart. The
# study has more of them (kgs/study/plots.py); pages show black as the colour of their text.
DEFAULT = "#CC79A7"
WITHOUT = "#000000"
_TEXT = "#303030"
_GRID = "#d8d8d8"
_CELL = 350  # pixels of the width of a picture on a sheet
_GAP = 10  # pixels between pictures
_TITLE = 28  # pixels of the height of a sheet's titles
_DRAWN = 4  # pixels that are drawn for one unit of a plot, before they are reduced
_REDUCED = 2  # of these in each direction become one of the file, whose lines are smooth then
_FONT = 13  # height of a plot's letters, in its units
_ROW = 20  # height of a row below a plot, in its units


def write_sheet(path: Path, views: Views, columns: dict[str, list[Tensor]], indices: list[int]) -> None:
    """Write a PNG of some views, a row each: the photo, then columns of renders `(3, H, W)` under their titles."""
    height, width = views.images.shape[-2:]
    size = _CELL, round(_CELL * height / width)
    pictures = {"photo, not used in training": list(views.images), **columns}
    sheet = Image.new("RGB", (len(pictures) * (_CELL + _GAP), _TITLE + len(indices) * (size[1] + _GAP)), "white")
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(16)
    way = cv2.INTER_AREA if width > _CELL else cv2.INTER_CUBIC
    for column, (title, images) in enumerate(pictures.items()):
        left = _GAP // 2 + column * (_CELL + _GAP)
        draw.text((left + _CELL // 2, _TITLE // 2), title, _TEXT, font, anchor="mm")
        for row, index in enumerate(indices):
            cell = cv2.resize(eight_bits(images[index]), size, interpolation=way)[:, :, ::-1]
            sheet.paste(Image.fromarray(np.ascontiguousarray(cell)), (left, _TITLE + row * (size[1] + _GAP)))
    _write(path, sheet)


def write_curve(path: Path, runs: dict[str, list[dict[str, Any]]]) -> None:
    """Plot test and training PSNR against seconds of training; runs "without ..." have a colour of their own.

    `runs` are the curves of metrics.json by the name of the run. Where none has two points, the plot says so.
    """
    plot = psnr_plot({name: {"curve": curve} for name, curve in runs.items()})
    if plot is None:
        empty = Image.new("RGB", (640, 80), "white")
        words = "The PSNR was not measured twice during the fit."
        ImageDraw.Draw(empty).text((320, 40), words, _TEXT, ImageFont.load_default(16), anchor="mm")
        _write(path, empty)
        return
    rows = 1 + (len(plot["lines"]) + 1) // 2
    figure = Image.new("RGB", (_DRAWN * plot["width"], _DRAWN * (plot["height"] + rows * _ROW)), "white")
    draw = ImageDraw.Draw(figure)
    _draw_axes(draw, plot)
    for i, line in enumerate(plot["lines"]):
        points = np.array([point.split(",") for point in line["points"].split()], float)
        left = plot["left"] + i % 2 * (plot["width"] - plot["left"]) / 2
        middle = plot["height"] + (1.5 + i // 2) * _ROW
        _draw_line(draw, points, line)
        _draw_line(draw, np.array([(left, middle), (left + 30, middle)]), line)
        _draw_text(draw, (left + 38, middle), line["label"], "lm")
    _write(path, figure.reduce(_REDUCED))


def _draw_axes(draw: ImageDraw.ImageDraw, plot: dict[str, Any]) -> None:
    """The grid of a plot with its numbers, and below it what they are."""
    for at, label in plot["x_ticks"]:
        _draw_grid(draw, (at, plot["top"]), (at, plot["bottom"]))
        _draw_text(draw, (at, plot["bottom"] + 14), label, "mm")
    for at, label in plot["y_ticks"]:
        _draw_grid(draw, (plot["left"], at), (plot["right"], at))
        _draw_text(draw, (plot["left"] - 6, at), label, "rm")
    words = "PSNR in dB over seconds of training"
    _draw_text(draw, (plot["left"], plot["height"] + _ROW / 2), words, "lm")


def _draw_grid(draw: ImageDraw.ImageDraw, begin: tuple[float, float], end: tuple[float, float]) -> None:
    draw.line([_DRAWN * value for value in (*begin, *end)], _GRID, _DRAWN)


def _draw_text(draw: ImageDraw.ImageDraw, position: tuple[float, float], text: str, anchor: str) -> None:
    font = ImageFont.load_default(_DRAWN * _FONT)
    draw.text((_DRAWN * position[0], _DRAWN * position[1]), text, _TEXT, font, anchor=anchor)


def _draw_line(draw: ImageDraw.ImageDraw, points: Any, line: dict[str, Any]) -> None:
    """A line of a plot through points `(P, 2)` in its units; a dotted one as dots at equal distances."""
    color = WITHOUT if line["method"] == "without" else DEFAULT
    corners = _DRAWN * points
    if not line["dotted"]:
        draw.line(list(map(tuple, corners)), color, 2 * _DRAWN, joint="curve")
        return
    lengths = np.append(0, np.linalg.norm(np.diff(corners, axis=0), axis=1).cumsum())
    distances = np.arange(0, lengths[-1], 5 * _DRAWN)
    for x, y in zip(*(np.interp(distances, lengths, column) for column in corners.T), strict=True):
        draw.ellipse((x - _DRAWN, y - _DRAWN, x + _DRAWN, y + _DRAWN), color)


def _write(path: Path, figure: Image.Image) -> None:
    content = BytesIO()
    figure.save(content, "png")
    write_whole(path, content.getvalue())
