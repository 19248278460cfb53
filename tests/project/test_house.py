"""The architecture: which module may import which, and what every public name says."""

import ast
import functools
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import kgs.fit

ROOT = Path(__file__).parents[2]
PACKAGES = {"kgs": "kgs", "losses": "kgs.losses", "datasets": "kgs.datasets"}  # folder, and the name it is installed by
PUBLIC = ("kgs", "kgs.losses", "kgs.datasets", "kgs.reference", "kgs.fit")
FLOORS = ("core", "io", "metrics", "sfm", "init_points", "fit", "page", "app", "bench", "study", "cli")
HEAVY = ("cv2", "PIL", "trimesh", "matplotlib", "tqdm", "tyro", "numba", "pycolmap", "pandas", "scipy", "distributed")


def module_name(path):
    folder, *rest = path.relative_to(ROOT).with_suffix("").parts
    return ".".join([PACKAGES[folder], *rest]).removesuffix(".__init__")


SOURCES = {module_name(path): path for folder in PACKAGES for path in sorted((ROOT / folder).rglob("*.py"))}


@functools.cache
def imports(name):
    """Absolute names of all that a module imports, at any depth of its code, for types only included."""
    path, found = SOURCES[name], set()
    package = name.split(".") if path.stem == "__init__" else name.split(".")[:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            found |= {f"{module}.{alias.name}" for alias in node.names}
    return found


def imported_modules(name):
    """Modules of ours among them: of `from a import b`, a.b where that is a module, else a."""
    return {known for known in (f if f in SOURCES else f.rpartition(".")[0] for f in imports(name)) if known in SOURCES}


def within(name, *modules):
    return any(name == module or name.startswith(module + ".") for module in modules)


def floor(name):
    if name == "kgs":
        return "face"  # which names what is elsewhere
    if within(name, "kgs.losses", "kgs.datasets"):
        return name.split(".")[1]
    above = [floor for floor in FLOORS[1:] if within(name, f"kgs.{floor}")]
    return above[0] if above else "core"


# -- imports -------------------------------------------------------------------------------------------------------


def test_there_are_no_circles():
    done, path = set(), []

    def visit(name):
        assert name not in path, " -> ".join([*path[path.index(name) :], name])
        if name not in done:
            path.append(name)
            for other in sorted(imported_modules(name) - {name}):
                visit(other)
            done.add(path.pop())

    for name in SOURCES:
        visit(name)
    assert done == set(SOURCES)


def test_imports_go_one_way():
    ground = {"core", "losses", "datasets", "io"}
    allowed = {
        "face": {"core", "io"},
        "core": {"core"},
        "losses": {"losses"},
        "datasets": {"datasets"},
        "io": ground,
        "metrics": ground | {"metrics"},
        "sfm": ground | {"sfm"},
        "init_points": ground | {"init_points", "sfm"},
        "fit": ground - {"io"} | {"fit", "init_points", "metrics"},
        "page": ground | {"page", "fit", "metrics", "app"},
        "app": ground | {"app", "page", "fit", "init_points", "sfm", "metrics"},
        "bench": {*FLOORS, "losses", "datasets"} - {"study", "cli"},
        "study": {*FLOORS, "losses", "datasets"} - {"cli"},
        "cli": {*FLOORS, "losses", "datasets"},
    }
    small = ("kgs.errors", "kgs.json_files", "kgs.backends", "kgs.lazy")  # what losses and datasets may use
    wrong = [
        (name, other)
        for name in SOURCES
        for other in sorted(imported_modules(name))
        if floor(other) not in allowed[floor(name)]
        and not (floor(name) in ("losses", "datasets") and within(other, *small))
    ]
    assert not wrong


def test_the_application_is_on_top():
    """The command and the page belong to it; they still stand in folders of their own."""
    clients = {name for name in SOURCES for other in imported_modules(name) if floor(other) == "app"}
    assert {floor(name) for name in clients} <= {"app", "cli", "page"}


def test_the_command_alone_imports_the_study():
    clients = {name for name in SOURCES for other in imported_modules(name) if floor(other) == "study"}
    assert {name for name in clients if floor(name) != "study"} == {"kgs.app.cli.study"}


def test_drop_imports_only_torch_and_the_reference_nothing_of_the_fast_path():
    assert {name.split(".")[0] for name in imports("kgs.drop")} - set(sys.stdlib_module_names) == {"torch"}
    assert imported_modules("kgs.reference") <= {"kgs.types"}


@pytest.fixture(scope="module")
def imported():
    """What one process finds after importing more and more, three lines. Torch itself imports tqdm where that is."""
    code = """
import sys
import kgs, kgs.app.cli.run, kgs.fit.config
print("heavy:", *{"torch", "numpy", "cv2", "PIL", "trimesh", "matplotlib", "tyro"} & set(sys.modules))
import torch
before = set(sys.modules)
kgs.GaussianRenderer
print(*sorted(set(sys.modules) - before))
sys.modules["resource"] = None
import kgs.fit.run, kgs.machine
from pathlib import Path
exists = Path.exists
Path.exists = lambda path: False if str(path).startswith("/proc") else exists(path)
print(kgs.machine.peak_rss_mb())
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def test_the_package_the_command_and_the_numbers_of_a_fit_are_read_without_heavy_libraries(imported):
    assert imported[0] == "heavy:"
    importlib.import_module("kgs.app.fit_folder")  # all modules of a fit
    assert not any(inspect.ismodule(getattr(kgs.fit, name)) for name in kgs.fit.__all__)


def test_no_module_of_one_system_alone(imported):
    """Windows has no `resource`: a fit can still be imported, and its memory is not known where nothing tells it."""
    assert imported[2] == "0"


def test_the_renderer_is_light(imported):
    new = imported[1].split()
    above = [f"kgs.{name}" for name in ("losses", "datasets", *FLOORS[2:], "reference")]
    assert "kgs.renderer" in new
    assert [name for name in new if within(name, *HEAVY, *above)] == []


# -- names and docstrings ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SOURCES)
def test_every_module_says_what_it_is_and_exports_what_it_has(name):
    if within(name, "kgs.backends.cpu", "kgs.compiled.kernel") or name.endswith("_kernels"):
        pytest.importorskip("numba")
    module = importlib.import_module(name)
    assert module.__doc__
    if len(ast.parse(SOURCES[name].read_text(encoding="utf-8")).body) == 1:
        return  # a folder with nothing of its own
    names = getattr(module, "__all__", ())  # modules of no public name need none
    assert len(set(names)) == len(names)
    missing = [exported for exported in names if not hasattr(module, exported)]
    assert not missing, "in __all__, but not there"


def described(name, value):
    """What the docstring of a public name does not say."""
    text = inspect.getdoc(value) or ""
    if not text or text.startswith(f"{value.__name__}("):  # what dataclass writes
        yield f"{name}: no docstring"
        return
    if inspect.isclass(value):
        for method_name, method in vars(value).items():
            function = getattr(method, "__func__", getattr(method, "fget", method))
            if not method_name.startswith("_") and inspect.isfunction(function) and not function.__doc__:
                yield f"{name}.{method_name}: no docstring"
        if issubclass(value, Exception):
            return
    if re.search(r"^ *Example:$", text, re.M):
        yield f"{name}: the site knows Examples, not Example"
    if "see there for arguments" in text:
        return
    signature = inspect.signature(value)
    for parameter in signature.parameters:
        if not re.search(rf"\b{parameter}\b", text):
            yield f"{name}: does not describe {parameter}"
    if signature.parameters and "Args:" not in text:
        yield f"{name}: no Args"
    result = inspect.formatannotation(signature.return_annotation)
    plain = re.match(r"'?(torch\.)?(Tensor|tuple|list|dict|float|int)\b", result)  # a class describes itself
    if inspect.isfunction(value) and plain and "Returns:" not in text:
        yield f"{name}: no Returns"


@pytest.mark.parametrize("module", PUBLIC)
def test_public_names_say_what_they_take_and_return(module):
    public = importlib.import_module(module)
    values = [(f"{module}.{name}", getattr(public, name)) for name in public.__all__]
    assert not [line for name, value in values if callable(value) for line in described(name, value)]


# -- words ---------------------------------------------------------------------------------------------------------


def test_no_file_names_a_place_on_a_disk():
    tracked = [path for folder in (*PACKAGES, "tests", "docs", ".ci") for path in (ROOT / folder).rglob("*")]
    texts = [path for path in tracked if path.suffix in {".py", ".md", ".json", ".jsonl", ".csv", ".tex", ".html", ""}]
    texts = [path for path in [*texts, *ROOT.glob("[!.]*.*")] if path.is_file()]
    place = re.compile(r"(?<![\w.:/<])/(?:home|root|work|tmp|Users)/\w")
    found = [
        (path.relative_to(ROOT).as_posix(), number)
        for path in texts
        for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1)
        if place.search(line)
    ]
    assert not found
