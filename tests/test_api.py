"""The public surface: what there is, what it is called, what importing it costs, and who may import whom."""

import ast
import configparser
import dataclasses
import importlib
import inspect
import math
import subprocess
import sys
from pathlib import Path

import pytest

import kgs

ROOT = Path(__file__).parents[1]
# to remove or rename a name, edit this list and the changelog in the same change
INVENTORY = {
    "kgs": [
        "DataError",
        "Densifier",
        "DensifyReport",
        "DropGaussian",
        "GaussianModel",
        "GaussianRenderer",
        "Gaussians",
        "PosedCamera",
        "ProjectedGaussians",
        "Rendering",
        "TileBins",
        "TrainingDiverged",
        "bin_to_tiles",
        "camera_extent",
        "cameras",
        "composite",
        "drop_gaussian",
        "load_ply",
        "project",
        "save_ply",
    ],
    "kgs.losses": ["TargetMoments", "opacity_l1", "photometric_loss", "target_moments"],
    "kgs.datasets": ["Scene", "Views", "load_scene", "synthetic_scene"],
    "kgs.reference": ["Layers", "layers", "render"],
}
PUBLIC = [(module, name) for module, names in INVENTORY.items() for name in names]
HEAVY = ("cv2", "trimesh", "matplotlib", "tqdm", "tyro", "pycolmap", "scipy", "viser", "distributed")


def sources(folder):
    return sorted((ROOT / folder).glob("*.py"))


def imported(path):
    """Absolute names of all modules that a file imports, at any depth of the code, with the line."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    package = list(parts if parts[0] == "kgs" else ("kgs", *parts))[:-1]
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            found += [(f"{module}.{alias.name}", node.lineno) for alias in node.names]
    return found


def within(name, *modules):
    return any(name == module or name.startswith(module + ".") for module in modules)


@pytest.mark.parametrize("module", INVENTORY)
def test_inventory(module):
    assert sorted(importlib.import_module(module).__all__) == sorted(INVENTORY[module])


@pytest.mark.parametrize(("module", "name"), PUBLIC)
def test_public_names_exist_and_are_described(module, name):
    value = getattr(importlib.import_module(module), name)
    assert value.__module__.startswith("kgs")
    assert (value.__doc__ or "").strip(), f"{module}.{name} has no docstring"
    assert not value.__doc__.startswith(f"{name}("), f"{module}.{name} has only what dataclass writes"
    if inspect.isclass(value):
        for method_name, method in vars(value).items():
            public = not method_name.startswith("_") and inspect.isfunction(method)
            assert not public or (method.__doc__ or "").strip(), f"{module}.{name}.{method_name} has no docstring"


@pytest.mark.parametrize("path", [*sources("kgs"), *sources("losses"), *sources("datasets")], ids=lambda p: p.stem)
def test_every_module_says_what_it_is_and_what_it_exports(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert ast.get_docstring(tree)
    assigned = [
        t.id for node in tree.body if isinstance(node, ast.Assign) for t in node.targets if isinstance(t, ast.Name)
    ]
    assert "__all__" in assigned
    parts = path.relative_to(ROOT).with_suffix("").parts
    module = importlib.import_module(
        ".".join(parts if parts[0] == "kgs" else ("kgs", *parts)).removesuffix(".__init__")
    )
    assert len(set(module.__all__)) == len(module.__all__)
    for name in module.__all__:
        assert hasattr(module, name), f"{path.name}: __all__ names {name}, which is not there"


def test_importing_kgs_is_light():
    # torch itself imports tqdm where it is installed
    code = "import sys, torch; before = set(sys.modules); import kgs; print(*sorted(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    new = done.stdout.split()
    above = [f"kgs.{name}" for name in ("losses", "datasets", "fit", "bench", "cli", "reference")]
    assert "kgs.renderer" in new
    assert [name for name in new if within(name, *HEAVY, *above)] == []


@pytest.mark.parametrize("path", [p for p in sources("kgs") if p.stem != "cli"], ids=lambda p: p.stem)
def test_the_core_imports_nothing_that_stands_on_it(path):
    above = [f"kgs.{name}" for name in ("losses", "datasets", "fit", "bench", "cli")]
    assert [i for i in imported(path) if within(i[0], *above, "losses", "datasets")] == []


@pytest.mark.parametrize("path", [*sources("losses"), *sources("datasets")], ids=lambda p: f"{p.parent.name}-{p.stem}")
def test_losses_and_datasets_import_only_the_errors_and_the_json_of_kgs(path):
    own = f"kgs.{path.parent.name}"
    allowed = (own, "kgs.errors", "kgs.json_files")
    assert [i for i in imported(path) if within(i[0], "kgs") and not within(i[0], *allowed)] == []


@pytest.mark.parametrize("path", sources("kgs/fit"), ids=lambda p: p.stem)
def test_the_fit_does_not_import_what_stands_on_it(path):
    assert [i for i in imported(path) if within(i[0], "kgs.cli", "kgs.bench")] == []


def test_drop_imports_only_torch_and_the_reference_nothing_of_the_fast_path():
    standard = set(sys.stdlib_module_names)
    drop = {name.split(".")[0] for name, _ in imported(ROOT / "kgs" / "drop.py")} - standard
    assert drop == {"torch"}
    reference = [name for name, _ in imported(ROOT / "kgs" / "reference.py") if within(name, "kgs")]
    assert all(within(name, "kgs.types") for name in reference)


def test_the_version_is_the_one_that_is_installed():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg", encoding="utf-8")
    assert kgs.__version__ == config["metadata"]["version"]


# name -> parameters in order, with defaults; "..." is a required one. What README and notebooks rely on
SIGNATURES = {
    "kgs.DropGaussian": {"p": 0.2, "schedule": "linear", "seed": None},
    "kgs.drop_gaussian": {"opacities": ..., "p": 0.2, "training": True, "generator": None},
    "kgs.GaussianRenderer": {
        "opacity_layer": None,
        "tile_size": 8,
        "near_plane": 0.01,
        "eps2d": 0.3,
        "alpha_threshold": 1 / 255,
        "transmittance_stop": 1e-4,
    },
    "kgs.GaussianRenderer.forward": {
        "self": ...,
        "gaussians": ...,
        "cameras": ...,
        "background": None,
        "outputs": ("image",),
    },
    "kgs.GaussianModel.from_points": {"points": ..., "colors": ..., "sh_degree": 3},
    "kgs.Gaussians": {"means": ..., "quats": ..., "scales": ..., "opacities": ..., "colors": ...},
    "kgs.PosedCamera": {"model": ..., "extrinsics": ...},
    "kgs.save_ply": {"path": ..., "model": ...},
    "kgs.load_ply": {"path": ...},
    "kgs.losses.photometric_loss": {"image": ..., "target": ..., "dssim_weight": 0.2},
    "kgs.datasets.load_scene": {"path": ..., "train_views": None, "downscale": None},
    "kgs.reference.render": {
        "gaussians": ...,
        "camera": ...,
        "background": None,
        "alpha_threshold": 1 / 255,
        "transmittance_stop": 1e-4,
        "near_plane": 0.01,
        "eps2d": 0.3,
    },
}


@pytest.mark.parametrize("name", SIGNATURES)
def test_signatures(name):
    module = max((m for m in INVENTORY if name.startswith(m + ".")), key=len)
    value = importlib.import_module(module)
    for part in name[len(module) + 1 :].split("."):
        value = getattr(value, part)
    found = {
        key: ... if parameter.default is inspect.Parameter.empty else parameter.default
        for key, parameter in inspect.signature(value).parameters.items()
    }
    expected = SIGNATURES[name]
    assert list(found)[: len(expected)] == list(expected)
    for key, default in expected.items():
        assert found[key] == default, key
    # what comes after may be left out
    assert all(found[key] is not ... for key in list(found)[len(expected) :])


def test_the_values_that_flow_are_frozen():
    for name in ("Gaussians", "PosedCamera", "ProjectedGaussians", "TileBins", "Rendering"):
        made = getattr(kgs, name)
        assert dataclasses.is_dataclass(made)
        assert made.__dataclass_params__.frozen
    assert {"image", "alpha", "depth", "projected"} <= {field.name for field in dataclasses.fields(kgs.Rendering)}
    assert math.isclose(kgs.GaussianRenderer().alpha_threshold, 1 / 255)


def test_progress_is_one_until_it_is_set():
    drop = kgs.DropGaussian()
    assert drop.progress == 1.0
    assert "progress=1.0 (never set)" in repr(drop)
    drop.progress = 0.25
    assert drop.progress == 0.25
    assert drop.rate == 0.05
    assert not drop.state_dict()
