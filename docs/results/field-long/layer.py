"""Draw layer.png beside this file: PSNR of fern during 10 000 steps, with and without DropGaussian, from sparse.jsonl.

python docs/results/field-long/layer.py
"""

import json
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

FOLDER = Path(__file__).parent
SCENE = "llff/fern"
METHODS = {"progressive 0.2": ("with dropping", "#00796b"), "off": ("without", "#c2185b")}
PANELS = {"test_psnr": "Photos held out: test PSNR [dB]", "train_psnr": "The three training photos: PSNR [dB]"}
INK = "#37474f"
STYLE = {
    "font.size": 11,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "grid.color": "#eceff1",
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
}


def curves() -> dict[str, list[dict[str, float]]]:
    """The measured points of each method."""
    lines = (FOLDER / "sparse.jsonl").read_text(encoding="utf-8").splitlines()
    cells = [json.loads(line) for line in lines]
    return {cell["cell"]["method"]: cell["result"]["curve"] for cell in cells if cell["cell"]["scene"] == SCENE}


def main() -> None:
    """Write layer.png: the photos held out on the left, the training photos on the right."""
    measured = curves()
    figure = Figure(figsize=(9.6, 3.6), dpi=160, layout="constrained", facecolor="white")
    figure.get_layout_engine().set(w_pad=0.12, h_pad=0.12)
    for axis, (key, title) in zip(figure.subplots(1, 2), PANELS.items(), strict=True):
        for method, (label, color) in METHODS.items():
            steps = [point["step"] for point in measured[method]]
            values = [point[key] for point in measured[method]]
            axis.plot(steps, values, "o-", color=color, linewidth=2.2, markersize=4.5, clip_on=False)
            end = axis.annotate(f"{values[-1]:.1f}\n{label}", (steps[-1], values[-1]), annotation_clip=False)
            end.set(color=color, fontweight="bold", va="center", linespacing=1.1)
            end.set_position((8, 0))
            end.set_anncoords("offset points")
        axis.set_title(title, loc="left", fontsize=11.5, fontweight="bold")
        axis.set_xlabel("training step")
        axis.set_xticks([0, 2500, 5000, 7500, 10_000])
        axis.set_xlim(0, 10_000)
        axis.grid(axis="y")
        axis.set_axisbelow(True)
    figure.savefig(FOLDER / "layer.png", pad_inches=0.1)


if __name__ == "__main__":
    with mpl.rc_context(STYLE):
        main()
