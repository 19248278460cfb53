"""Store renders, gradients, two short fits and the cost of a step, to compare two versions of kgs bit by bit.

    python store.py write before.pt       # with the one version installed
    python store.py write after.pt        # with the other
    python store.py compare before.pt after.pt

`write` needs `KGS_DATA`, the folder of real scenes, for the fit of fern. It uses public names alone, so it runs with
versions whose files lie elsewhere. `compare` prints the largest difference of each tensor that is not the same.
"""

import argparse
import os
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel, CameraModelType
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import kgs
from kgs.datasets import load_scene, synthetic_scene
from kgs.fit import FitConfig, Trainer

try:
    from kgs.init_points import initial_points
except ImportError:
    from kgs.fit import first_points as initial_points

pinhole_cameras = getattr(kgs, "pinhole_cameras", None) or kgs.cameras
FIELDS = ("means", "quats", "scales", "opacities", "colors")
WIDTH, HEIGHT, FOCAL = 132, 99, 110.0


def random_gaussians(count: int = 3000, degree: int = 0, channels: int = 0, seed: int = 0) -> dict[str, Tensor]:
    """A cloud before the camera: depths of 2 to 8, about 2 pixels wide, most of them visible."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    depths = 2 + 6 * torch.rand(count, generator=generator)
    places = (torch.rand(count, 2, generator=generator) - 0.5) * torch.tensor([1.4, 1.1]) * depths[:, None]
    shape = (count, channels) if channels else (count, (degree + 1) ** 2, 3)
    return {
        "means": torch.cat([places, depths[:, None]], 1),
        "quats": normal(count, 4),
        "scales": torch.exp(0.6 * normal(count, 3)) * depths[:, None] * 2.5 / FOCAL,
        "opacities": torch.sigmoid(1.5 * normal(count)),
        "colors": normal(*shape) * 0.5,
    }


def poses(count: int) -> Tensor:
    """World-to-camera poses, `(count, 4, 4)`: the first is the identity, the others turn and move a little."""
    found = torch.eye(4).repeat(count, 1, 1)
    for i in range(1, count):
        turn = torch.tensor([[0.0, -0.02, 0.03], [0.02, 0.0, -0.01], [-0.03, 0.01, 0.0]]) * i
        found[i, :3, :3] = torch.linalg.matrix_exp(turn.double()).float()
        found[i, :3, 3] = torch.tensor([0.1, -0.05, 0.08]) * i
    return found


def intrinsics() -> Tensor:
    """A pinhole with unequal focal lengths, `(3, 3)`."""
    return torch.tensor([[FOCAL, 0.0, (WIDTH - 1) / 2], [0.0, FOCAL * 1.01, (HEIGHT - 1) / 2], [0.0, 0.0, 1.0]])


def pinholes(count: int = 1, dtype: torch.dtype = torch.float32) -> Any:
    """Some pinhole cameras."""
    return pinhole_cameras(poses(count).to(dtype), intrinsics().to(dtype), width=WIDTH, height=HEIGHT)


def lens(kind: CameraModelType, extra: tuple[float, ...] = ()) -> Any:
    """Two poses of a camera with the lens parameters `extra`."""
    matrix = intrinsics()
    first = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    params = torch.tensor([*map(float, first), *extra])
    return kgs.PosedCamera(CameraModel(ImageSize(HEIGHT, WIDTH), kind, params), poses(2))


def needles() -> dict[str, Tensor]:
    """Gaussians 8 times as long and 10 000 times as thin."""
    values = random_gaussians(800, 1, seed=5)
    values["scales"] = values["scales"] * torch.tensor([8.0, 0.05, 1e-4])
    return values


def opaque() -> dict[str, Tensor]:
    """Opacities up to 2, as `DropGaussian` makes them."""
    values = random_gaussians(1500, seed=6)
    values["opacities"] = values["opacities"] * 2
    return values


def per_camera_opacities() -> dict[str, Tensor]:
    """One opacity for each of two cameras."""
    values = random_gaussians(1500, seed=7)
    values["opacities"] = torch.stack([values["opacities"], values["opacities"].flip(0)])
    return values


def with_nan() -> dict[str, Tensor]:
    """Some Gaussians that are not finite."""
    values = random_gaussians(1000, seed=8)
    values["means"][::50] = torch.nan
    values["scales"][1::50] = torch.inf
    return values


def as_float64(values: dict[str, Tensor]) -> dict[str, Tensor]:
    """The same in float64."""
    return {name: value.double() for name, value in values.items()}


def renders() -> Iterator[tuple[str, dict[str, Tensor], Any, dict[str, Any], dict[str, Any]]]:
    """Name, fields of the Gaussians, cameras, arguments of the renderer and of the call."""
    background = {"background": torch.tensor([0.2, 0.5, 0.9])}
    brown = lens(CameraModelType.BROWN_CONRADY, (-0.1, 0.02, 0.001, -0.001, 0.0, 0.0, 0.0, 0.0))
    fisheye = lens(CameraModelType.KANNALA_BRANDT_K3, (0.02, -0.005, 0.001, 0.0))
    everything = {"outputs": ("image", "alpha", "depth", "median_depth", "normal")}
    yield "plain", random_gaussians(), pinholes(), {}, {}
    yield "harmonics of degree 3", random_gaussians(degree=3, seed=1), pinholes(3), {}, background
    yield "harmonics of degree 1", random_gaussians(degree=1, seed=2), pinholes(2), {}, background
    yield "five features", random_gaussians(channels=5, seed=3), pinholes(), {}, {}
    yield "all outputs", random_gaussians(degree=2, seed=4), pinholes(2), {}, everything
    yield "needles", needles(), pinholes(), {}, background
    yield "opacities above 1", opaque(), pinholes(), {}, {}
    yield "opacities per camera", per_camera_opacities(), pinholes(2), {}, background
    yield "no alpha threshold", random_gaussians(600, seed=9), pinholes(), {"alpha_threshold": 0.0}, {}
    yield "no transmittance stop", random_gaussians(2000, seed=10), pinholes(), {"transmittance_stop": 0.0}, background
    yield "little memory", random_gaussians(seed=11), pinholes(2), {"max_bytes": 6_000_000}, {}
    yield "tiles of 16", random_gaussians(seed=12), pinholes(), {"tile_size": 16}, background
    yield "float64", as_float64(random_gaussians(1500, 3, seed=13)), pinholes(1, torch.float64), {}, everything
    yield "not finite", with_nan(), pinholes(), {}, background
    yield "distorted lens", random_gaussians(1000, 3, seed=14), brown, {}, {}
    yield "fisheye", random_gaussians(1000, seed=15), fisheye, {}, background


def render_all(backend: str) -> dict[str, dict[str, Tensor]]:
    """Outputs of each render, and the gradients of their sum with random weights."""
    found = {}
    for name, values, cameras, options, call in renders():
        leaves = {key: value.clone().requires_grad_() for key, value in values.items()}
        gaussians = kgs.Gaussians(**leaves)
        dtype = values["means"].dtype
        covered = dtype == torch.float32 and options.get("tile_size", 8) == 8
        chosen = backend if covered or backend == "torch" else "auto"
        rendering = kgs.GaussianRenderer(backend=chosen, **options)(gaussians, cameras, **call)
        images = {key: getattr(rendering, key) for key in ("image", "alpha", "depth", "median_depth", "normal")}
        images = {key: image for key, image in images.items() if image is not None}
        generator = torch.Generator().manual_seed(0)
        loss = torch.zeros((), dtype=dtype)
        for image in images.values():
            weights = torch.randn(image.shape, generator=generator, dtype=dtype)
            if image.requires_grad:
                loss = loss + (image * weights).sum()
        loss.backward()
        gradients = {f"d {key}": leaf.grad for key, leaf in leaves.items() if leaf.grad is not None}
        found[name] = {key: value.detach().clone() for key, value in (images | gradients).items()}
    return found


def pose_gradients(backend: str) -> dict[str, Tensor]:
    """Gradients with respect to poses, intrinsics and background."""
    extrinsics = poses(2).requires_grad_()
    matrix = intrinsics().requires_grad_()
    background = torch.tensor([0.2, 0.5, 0.9], requires_grad=True)
    cameras = pinhole_cameras(extrinsics, matrix, width=WIDTH, height=HEIGHT)
    gaussians = kgs.Gaussians(**random_gaussians(1500, 3, seed=20))
    image = kgs.GaussianRenderer(backend=backend)(gaussians, cameras, background).image
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
    (image * weights).sum().backward()
    return {"extrinsics": extrinsics.grad, "intrinsics": matrix.grad, "background": background.grad}


def fit(scene: Any, backend: str) -> dict[str, Tensor]:
    """The Gaussians after 60 steps with dropping, densification and harmonics, and the losses on the way."""
    points = initial_points(scene.train, "random", count=1500, seed=0)
    config = FitConfig(steps=60, sh_degree=1, seed=3, backend=backend, evaluations=1)
    try:
        from kgs.fit import make_plan
    except ImportError:
        plan = config
    else:
        plan = make_plan(scene, config)
    trainer = Trainer(scene, plan, points)
    losses = [trainer.train_step() for _ in range(config.steps)]
    return {"losses": torch.tensor(losses)} | {k: v.detach().clone() for k, v in trainer.model.named_parameters()}


class OperatorCounter(TorchDispatchMode):
    """Counts operators, and those after which the host waits for the device."""

    WAITS = (
        "_local_scalar_dense",
        "nonzero",
        "masked_select",
        "_unique2",
        "unique_dim",
        "unique_consecutive",
        "bincount",
    )

    def __init__(self) -> None:
        super().__init__()
        self.operators: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func.overloadpacket.__name__
        self.operators[name] += not func.is_view
        if name == "index" and any(x is not None and x.dtype in (torch.bool, torch.uint8) for x in args[1]):
            self.operators["nonzero"] += 1  # a mask as an index: its size depends on the data
        return func(*args, **(kwargs or {}))

    @property
    def waits(self) -> int:
        """How often the host waits for the device."""
        return sum(self.operators[name] for name in self.WAITS)


@contextmanager
def settings_of_a_gpu() -> Iterator[None]:
    """One thread, and the chunks and scans that a GPU would get, on a CPU."""
    with ExitStack() as stack:
        stack.enter_context(mock.patch("torch.get_num_threads", return_value=1))
        try:
            from kgs.raster import tasks, torch_passes
        except ImportError:
            from kgs.backends.torch import compositing

            stack.enter_context(mock.patch.dict(compositing.SETTINGS, cpu=compositing.SETTINGS["cuda"]))
            yield
            return
        stack.enter_context(mock.patch.dict(tasks._STEP_PAIRS, {"cpu": tasks._STEP_PAIRS["cuda"]}))
        owner = torch_passes if hasattr(torch_passes, "choose_chunk_size") else tasks
        stack.enter_context(mock.patch.object(owner, "choose_chunk_size", return_value=32))
        make = tasks.Slice._make_groups

        def make_groups(part: Any, lengths: Tensor) -> Any:
            part.by_layer = False
            return make(part, lengths)

        stack.enter_context(mock.patch.object(tasks.Slice, "_make_groups", make_groups))
        yield


def cost() -> dict[str, int]:
    """Operators and synchronisations of one forward and backward pass of 50 000 Gaussians at 504 x 378."""
    from kgs.bench.scenes import layered_scene

    model, camera = layered_scene(50_000)
    renderer = kgs.GaussianRenderer(backend="torch")
    with settings_of_a_gpu(), OperatorCounter() as counter:
        image = renderer(model(), camera).image
        image.sum().backward()
    return {"operators": sum(counter.operators.values()), "synchronisations": counter.waits}


def write(path: Path) -> None:
    """Store everything in one file."""
    room = synthetic_scene("room", train_views=3, test_views=1, size=(96, 128))
    fern = load_scene(Path(os.environ["KGS_DATA"]) / "llff" / "fern", train_views=3, downscale=2)
    found: dict[str, Any] = {"cost": cost()}
    print("cost:", found["cost"], flush=True)
    for backend in ("numba", "torch"):
        jobs: dict[str, Callable[[], Any]] = {
            "renders": lambda backend=backend: render_all(backend),
            "poses": lambda backend=backend: {"poses": pose_gradients(backend)},
            "fits": lambda backend=backend: {"room": fit(room, backend), "fern": fit(fern, backend)},
        }
        for name, job in jobs.items():
            found[f"{backend} {name}"] = job()
            print("stored:", backend, name, flush=True)
    torch.save(found, path)


def compare(before: Path, after: Path) -> None:
    """Print what differs between two files."""
    old, new = (torch.load(path) for path in (before, after))
    print("cost before:", old.pop("cost"), "after:", new.pop("cost"))
    same = 0
    for group, cases in old.items():
        for case, tensors in cases.items():
            for name, tensor in tensors.items():
                other = new[group][case][name]
                if tensor.shape != other.shape:
                    print(f"{group}, {case}, {name}: shape {tuple(tensor.shape)} before, {tuple(other.shape)} after")
                elif torch.equal(tensor.nan_to_num(7.7), other.nan_to_num(7.7)):
                    same += 1
                else:
                    difference = (tensor - other).abs().max() / tensor.abs().max()
                    print(f"{group}, {case}, {name}: {float(difference):.2g} of the largest value")
    print(f"{same} tensors are the same, bit by bit")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("write").add_argument("path", type=Path)
    both = commands.add_parser("compare")
    both.add_argument("before", type=Path)
    both.add_argument("after", type=Path)
    arguments = parser.parse_args()
    if arguments.command == "write":
        write(arguments.path)
    else:
        compare(arguments.before, arguments.after)
