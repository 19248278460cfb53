"""How kernels are called where there is a GPU: what was compiled is called again, by a key as fine as Triton's own."""

import itertools
from types import SimpleNamespace

import pytest
import torch
import triton
import triton.language as tl

from kgs.backends.gpu import launch as module
from kgs.backends.gpu.launch import launch, specialization

jit = pytest.importorskip("triton.runtime.jit")


def example(x, y, n, begin, scale, BLOCK: tl.constexpr):
    """A kernel's arguments: tensors, an integer, one that is not specialized, and a number."""


def kernel():
    return jit.JITFunction(example, do_not_specialize=["begin"])


INTEGERS = [-(2**31) - 1, -(2**31), -32, -1, 0, 1, 2, 15, 16, 17, 2**31 - 1, 2**31, 2**31 + 1, 2**40, 2**63, 2**63 + 1]


def tensors():
    """Of several dtypes, at multiples of 16 and beside them; one of more than 2 GiB, of which nothing is touched."""
    types = (torch.float32, torch.int64, torch.int32, torch.int16, torch.int8)
    wide = torch.empty(2**31 + 64, dtype=torch.int8)
    few = [torch.zeros(64, dtype=dtype) for dtype in types]
    assert all(x.data_ptr() % 16 == 0 for x in (*few, wide))
    return [*few, *(x[1:] for x in few), few[0][4:], few[4][16:], wide]


def calls():
    """Arguments that differ in one or several ways."""
    x, y = torch.zeros(64), torch.zeros(64)
    for value in tensors():
        yield value, y, 3, 0, 1.0
        yield x, value, 3, 0, 1.0
    for n, begin in itertools.product(INTEGERS, [0, 1, 5, 16, 2**31, 2**63]):
        yield x, y, n, begin, 1.0
    for scale in (0.0, 1.0, 16.0, 0.5, True, False, 1, 16):
        yield x, y, 3, 0, scale
    yield x[1:], y[1:], 1, 1, 1.0


def of_triton(target):
    """What Triton itself makes of arguments for a target: a function."""
    try:
        from triton.compiler import make_backend

        backend = make_backend(triton.backends.compiler.GPUTarget(*target))
        function = kernel()
        binder = jit.create_function_from_signature(function.signature, function.params, backend)
        found = binder(*next(calls()), BLOCK=8)[1]
    except (ImportError, AttributeError, TypeError):
        pytest.skip("another version of Triton")
    if not isinstance(found, list):
        pytest.skip("another version of Triton")
    return lambda arguments: binder(*arguments, BLOCK=8)[1]


@pytest.mark.parametrize("target", [("cuda", 90, 32), ("hip", "gfx942", 64)], ids=["NVIDIA", "AMD"])
def test_the_key_differs_exactly_where_tritons_own_does(target, monkeypatch):
    monkeypatch.setenv("AMDGCN_USE_BUFFER_OPS", "1")  # the default of newer versions
    monkeypatch.setattr(module, "_IS_AMD", target[0] == "hip")
    own = of_triton(target)
    function = kernel()
    table = list(calls())
    ours = [specialization(function, arguments, ())[0] for arguments in table]
    theirs = [own(arguments) for arguments in table]
    assert None not in ours
    pairs = list(itertools.combinations(range(len(table)), 2))
    assert len(pairs) > 5000
    assert 0.01 < sum(theirs[i] == theirs[j] for i, j in pairs) / len(pairs) < 0.5
    wrong = [(i, j) for i, j in pairs if (ours[i] == ours[j]) != (theirs[i] == theirs[j])]
    assert not [(table[i], table[j]) for i, j in wrong]


def test_the_key_differs_by_kernel_and_by_all_else_that_is_given():
    x = torch.zeros(8)
    one, other = kernel(), kernel()
    keys = {specialization(k, (x, x, 3, 0, 1.0), rest)[0] for k in (one, other) for rest in ((), (0, 4), (1, 4))}
    assert len(keys) == 6
    assert specialization(one, (x, None, 3, 0, 1.0), ())[0] is None


# -- with a kernel that only records ------------------------------------------------------------------------------


class Compiled:
    """What Triton keeps of a compiled kernel, as far as it is used; records how it is run."""

    function = "function"
    packed_metadata = (4, 1, 0)

    def __init__(self):
        self.runs = []

    def run(self, *arguments):
        self.runs.append(arguments)


class Kernel:
    """What Triton's `jit` returns, as far as it is used: a new `compiled` for each call."""

    def __init__(self, compiled=Compiled):
        self.params = kernel().params
        self.pre_run_hooks = []
        self.device_caches = {}
        self.calls = []
        self.compiled = []
        self.kind = compiled

    def __getitem__(self, grid):
        def call(*arguments, **options):
            self.calls.append((grid, arguments, options))
            self.compiled.append(self.kind())
            return self.compiled[-1]

        return call


@pytest.fixture(autouse=True)
def _on_a_gpu(monkeypatch):
    """As if CPUs were GPUs; what is compiled is forgotten afterwards."""
    monkeypatch.setattr(module, "_DIRECT", ("cpu",))
    monkeypatch.setattr(module, "_stream", lambda device: 77)
    monkeypatch.setattr(module, "_compiled", {})
    monkeypatch.setattr(module, "_arguments", {})


def test_a_second_call_runs_what_was_compiled_with_pointers():
    fake = Kernel()
    x, y, z = torch.zeros(8), torch.zeros(8), torch.zeros(4)
    launch(fake, (3, 2), x, y, 5, 0, 0.5, BLOCK=8)
    assert fake.calls == [((3, 2), (x, y, 5, 0, 0.5), {"BLOCK": 8, "num_warps": 4, "enable_fp_fusion": True})]
    launch(fake, (7,), z, y, 6, 9, 0.25, BLOCK=8)
    assert len(fake.calls) == 1
    given = (z.data_ptr(), y.data_ptr(), 6, 9, 0.25, 8)
    assert fake.compiled[0].runs == [(7, 1, 1, 77, "function", (4, 1, 0), None, None, None, *given)]
    del fake.device_caches  # Triton 3.2: without constants
    launch(fake, (7, 1, 2), z, y, 6, 9, 0.25, BLOCK=8)
    assert fake.compiled[0].runs[1] == (7, 1, 2, 77, "function", (4, 1, 0), None, None, None, *given[:-1])
    launch(fake, (7, 0), z, y, 6, 9, 0.25, BLOCK=8)
    assert len(fake.compiled[0].runs) == 2


def test_another_card_is_compiled_for_anew(monkeypatch):
    fake = Kernel()
    x = torch.zeros(8)
    seen = set()
    real = specialization
    monkeypatch.setattr(module, "specialization", lambda *a: seen.add(a[2][0]) or real(*a))
    monkeypatch.setattr(module, "current", lambda device: module.nullcontext())
    for index in (0, 1):
        device = SimpleNamespace(type="cpu", index=index)
        monkeypatch.setattr(module, "_device_of", lambda arguments, device=device: device)
        launch(fake, (1,), x, x, 5, 0, 0.5, BLOCK=8)
    assert seen == {0, 1}
    assert len(fake.calls) == 2


@pytest.mark.parametrize("lacking", ["run", "function", "packed_metadata"])
def test_where_triton_lacks_what_is_needed_it_launches(lacking):
    class Other:
        """Of another version of Triton."""

    for name in {"run", "function", "packed_metadata"} - {lacking}:
        setattr(Other, name, None)
    fake = Kernel(Other)
    x = torch.zeros(8)
    for _ in range(2):
        launch(fake, (1,), x, x, 5, 0, 0.5, BLOCK=8)
    assert len(fake.calls) == 2


def test_where_a_hook_listens_triton_launches(monkeypatch):
    fake = Kernel()
    x = torch.zeros(8)
    for _ in range(2):
        launch(fake, (1,), x, x, 5, 0, 0.5, BLOCK=8)
    assert len(fake.calls) == 1
    fake.pre_run_hooks.append(print)
    launch(fake, (1,), x, x, 5, 0, 0.5, BLOCK=8)
    assert len(fake.calls) == 2
    fake.pre_run_hooks.clear()
    settings = SimpleNamespace(launch_enter_hook=None, launch_exit_hook=SimpleNamespace(calls=[]))
    monkeypatch.setattr(module, "_settings", lambda: settings)
    launch(fake, (1,), x, x, 5, 0, 0.5, BLOCK=8)
    assert len(fake.calls) == 2
    for hook in (print, SimpleNamespace(calls=[print])):
        settings.launch_enter_hook = hook
        launch(fake, (1,), x, x, 5, 0, 0.5, BLOCK=8)
    assert len(fake.calls) == 4


def test_on_other_devices_triton_launches(monkeypatch):
    monkeypatch.setattr(module, "_DIRECT", ("cuda",))
    fake = Kernel()
    x = torch.zeros(8)
    for _ in range(2):
        launch(fake, (1,), x, x, 5, 0, 0.5, BLOCK=8)
    assert len(fake.calls) == 2
