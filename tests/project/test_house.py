"""The architecture: which module may import which, and what every public name says."""

import ast
import functools
import graphlib
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = {"kgs": "kgs", "losses": "kgs.losses", "datasets": "kgs.datasets"}  # folder, and the name it is installed by
PUBLIC = ("kgs", "kgs.losses", "kgs.datasets", "kgs.reference", "kgs.fit")
GROUND = {"core", "backends", "geometry", "_support"}  # what stands in kgs itself is the core
LIBRARY = {*GROUND, "gsplat", "losses", "datasets", "metrics", "init_points", "fit", "bench"}
MAY_IMPORT = {  # a room, and the others that it may import
    "kgs": {"core", "geometry", "gsplat", "_support"},  # the face, which names what is elsewhere
    "core": {"backends", "geometry", "_support"},
    "_support": set(),
    "geometry": {"_support"},
    "backends": {"geometry", "_support"},
    "gsplat": GROUND,
    "losses": {"backends", "_support"},
    "datasets": {"geometry", "_support"},
    "metrics": GROUND | {"datasets"},
    "init_points": GROUND | {"datasets"},
    "fit": GROUND | {"losses", "datasets", "metrics", "init_points"},
    "bench": GROUND | {"losses", "fit"},
    "app": LIBRARY,  # which prints, locks and publishes: no other room but the study knows it
    "study": LIBRARY | {"app"},  # which no other room knows
}
SENSORS = "kgs.geometry.camera_models"  # Kornia promises nothing of `kornia.sensors`
PINHOLE = "kornia.geometry.camera.PinholeCamera"
HEAVY = ("cv2", "PIL", "trimesh", "matplotlib", "tqdm", "tyro", "numba", "pycolmap", "pandas", "scipy", "distributed")


def module_name(path):
    folder, *rest = path.relative_to(ROOT).with_suffix("").parts
    return ".".join([PACKAGES[folder], *rest]).removesuffix(".__init__")


SOURCES = {module_name(path): path for folder in PACKAGES for path in sorted((ROOT / folder).rglob("*.py"))}


@functools.cache
def nodes(name):
    """All of the code of a module."""
    return [*ast.walk(ast.parse(SOURCES[name].read_text(encoding="utf-8")))]


@functools.cache
def imports(name):
    """Absolute names of all that a module imports, at any depth of its code, for types only included."""
    path, found = SOURCES[name], set()
    package = name.split(".") if path.stem == "__init__" else name.split(".")[:-1]
    for node in nodes(name):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            found |= {f"{module}.{alias.name}" for alias in node.names}
    return found


@functools.cache
def imported_modules(name):
    """Modules of ours among them: of `from a import b`, a.b where that is a module, else a."""
    return {known for known in (f if f in SOURCES else f.rpartition(".")[0] for f in imports(name)) if known in SOURCES}


def within(name, *modules):
    return any(name == module or name.startswith(module + ".") for module in modules)


def room(name):
    first, *rest = name.split(".")
    if not rest:
        return first
    return rest[0] if rest[0] in MAY_IMPORT else "core"


def pairs():
    """Each module with each module of ours that it imports."""
    return [(name, other) for name in SOURCES for other in sorted(imported_modules(name) - {name})]


def cycle(graph):
    """Names that import each other in a circle, or none."""
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


# -- imports -------------------------------------------------------------------------------------------------------


def test_no_files_import_each_other():
    assert not cycle({name: imported_modules(name) - {name} for name in SOURCES})


FOLDERS = [name for name, path in SOURCES.items() if path.stem == "__init__"]


@pytest.mark.parametrize("folder", FOLDERS)
def test_no_folders_import_each_other(folder):
    """Nor a folder and a file beside it: a part of a folder is all that stands below one of its names."""
    depth = folder.count(".") + 2
    graph = {}
    for name, other in pairs():
        if name.startswith(f"{folder}.") and other.startswith(f"{folder}."):
            part, imported = (".".join(module.split(".")[:depth]) for module in (name, other))
            graph.setdefault(part, set()).update({imported} - {part})
    assert not cycle(graph)


def test_imports_go_one_way():
    wrong = [pair for pair in pairs() if room(pair[1]) not in MAY_IMPORT[room(pair[0])] | {room(pair[0])}]
    assert not wrong


def test_what_single_files_may_import():
    assert {name.split(".")[0] for name in imports("kgs.drop")} - set(sys.stdlib_module_names) == {"torch"}
    assert [name for name in SOURCES if any(within(other, "kornia.sensors") for other in imports(name))] == [SENSORS]
    support = {"kgs._support.checks", "kgs._support.default_device"}
    assert imported_modules("kgs.reference") == {*support, "kgs.geometry.types"}
    assert {name for name in imports("kgs.reference") if name.startswith("kornia")} == {PINHOLE}


def test_what_is_imported_is_light():
    """What one process finds after importing more and more. Torch itself imports tqdm where that is."""
    code = """
import sys
import kgs, kgs.app.cli.run, kgs.fit.config
print("heavy:", *{"torch", "numpy", "cv2", "PIL", "trimesh", "matplotlib", "tyro"} & set(sys.modules))
import torch
before = set(sys.modules)
kgs.GaussianRenderer
print(*sorted(set(sys.modules) - before))
sys.modules["resource"] = None
import kgs.fit.run, kgs._support.machine, kgs.datasets.load
from kgs.fit.adam import Adam
x = torch.ones(3, requires_grad=True)
adam = Adam([{"params": [x], "name": "x", "lr": 0.1}])
x.sum().backward()
adam.step()
adam.zero_grad()
print("slow:", *{"scipy.spatial", "networkx", "trimesh", "matplotlib", "torch._dynamo"} & set(sys.modules))
from pathlib import Path
exists = Path.exists
Path.exists = lambda path: False if str(path).startswith("/proc") else exists(path)
print(kgs._support.machine.peak_rss_mb())
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    at_first, by_the_renderer, by_a_fit, memory = done.stdout.splitlines()
    assert at_first == "heavy:"  # the package, the command and the numbers of a fit
    new = by_the_renderer.split()
    others = {"losses", "datasets", "metrics", "init_points", "fit", "bench", "app", "study", "reference"}
    above = [f"kgs.{name}" for name in others]
    assert "kgs.renderer" in new
    assert [name for name in new if within(name, *HEAVY, *above)] == []
    assert by_a_fit == "slow:"  # of photos: packages that it does not call
    assert memory == "0"  # Windows has no `resource`: the memory of a fit is not known where nothing tells it


# -- values --------------------------------------------------------------------------------------------------------


def dataclasses_of(name):
    """The dataclasses of a module: name, whether `==` is identity, and the words of its fields' types."""
    for node in nodes(name):
        if not isinstance(node, ast.ClassDef):
            continue
        decorator = next((ast.unparse(each) for each in node.decorator_list if "dataclass" in ast.unparse(each)), "")
        types = [ast.unparse(field.annotation) for field in node.body if isinstance(field, ast.AnnAssign)]
        if decorator:
            words_of = {word for text in types if "Callable" not in text for word in re.findall(r"\w+", text)}
            yield node.name, "eq=False" in decorator, words_of


def test_a_value_that_holds_tensors_is_equal_to_itself_alone():
    """`==` of a generated `__eq__` would ask whether a tensor is true, which is an error."""
    known = [(module, *found) for module in SOURCES for found in dataclasses_of(module)]
    held = {"Tensor", "NDArray", "Array", "PinholeCamera", "GaussianModel"}
    for _ in range(4):  # as deep as values hold values
        held |= {name for _, name, _, types in known if types & held}
    assert not [(module, name) for module, name, by_identity, types in known if types & held and not by_identity]


# -- errors --------------------------------------------------------------------------------------------------------

PLAIN = {"kgs.drop", "kgs.reference"}  # import nothing of kgs
PLAIN |= {"kgs._support.json_files", "kgs.datasets.image_file"}  # whose readers turn them into DataErrors


def test_a_wrong_value_is_an_argument_error():
    """Of a plain ValueError the command shows the traceback: it comes from torch or NumPy, and is no user's mistake."""
    raised = [(name, node.exc) for name in SOURCES for node in nodes(name) if isinstance(node, ast.Raise)]
    plain = {name for name, error in raised if error is not None and ast.unparse(error).startswith("ValueError")}
    assert plain <= PLAIN


# -- names and docstrings ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SOURCES)
def test_every_module_says_what_it_is_and_exports_what_it_has(name):
    if within(name, "kgs.backends.cpu", "kgs._support.compiled.kernel", "kgs._support.compiled.lanes") or name.endswith(
        "_kernels"
    ):
        pytest.importorskip("numba")
    module = importlib.import_module(name)
    assert module.__doc__
    if len(nodes(name)[0].body) == 1:
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


def test_no_file_names_a_path_on_a_disk():
    tracked = [path for folder in (*PACKAGES, "tests", "docs", ".ci") for path in (ROOT / folder).rglob("*")]
    texts = [path for path in tracked if path.suffix in {".py", ".md", ".json", ".jsonl", ".csv", ".tex", ".html", ""}]
    texts = [path for path in [*texts, *ROOT.glob("[!.]*.*")] if path.is_file()]
    absolute = re.compile(r"(?<![\w.:/<])/(?:home|root|work|tmp|Users)/(?!jane)\w")  # who is made up
    found = [
        (path.relative_to(ROOT).as_posix(), number)
        for path in texts
        for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), 1)
        if absolute.search(line)
    ]
    assert not found
