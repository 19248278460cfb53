"""gsplat's strategies on kgs: they train as they do on gsplat's own projection."""

from itertools import pairwise, product

import pytest
import torch

from kgs import rasterization

pytest.importorskip("gsplat")
from gsplat import strategy as strategies
from gsplat.cuda import _torch_impl
from gsplat.strategy import ops
from gsplat_reference import gsplat_render

pytestmark = pytest.mark.usefixtures("torch_alone")

SIZE = (12, 16)  # height, width
EXACT = {"alpha_threshold": 0.0, "transmittance_stop": 0.0}


@pytest.fixture(autouse=True)
def _without_a_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: None)


def gaussians(n=40, dtype=torch.float64):
    """Parameters as gsplat's trainers have them, of Gaussians well inside the image, some large on the screen."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    depths = 3 + uniform(n)
    xy = (uniform(n, 2) - 0.5) * torch.tensor([0.4, 0.3]) * depths[:, None]
    values = {
        "means": torch.cat([xy, depths[:, None]], 1),
        "scales": torch.log(0.02 + 0.1 * uniform(n, 3)),
        "quats": uniform(n, 4) - 0.5,
        "opacities": 4 * uniform(n) - 2,
        "colors": uniform(n, 3),
    }
    return {name: torch.nn.Parameter(value.to(dtype)) for name, value in values.items()}


def cameras(dtype):
    k = torch.tensor([[[15.0, 0, 8], [0, 15, 6], [0, 0, 1]]], dtype=dtype)
    return {"viewmats": torch.eye(4, dtype=dtype)[None], "Ks": k}


def activated(params):
    shown = {"quats": torch.nn.functional.normalize(params["quats"], dim=1), "scales": params["scales"].exp()}
    shown |= {"opacities": 0.95 * params["opacities"].sigmoid()}  # gsplat clamps alphas at 0.999, kgs at 0.99
    return {"means": params["means"], "colors": params["colors"]} | shown


def train(strategy, render, steps, after=None, dtype=torch.float64):
    """The number of Gaussians after each step, the losses, and the strategy's state."""
    torch.manual_seed(0)
    params = gaussians(dtype=dtype)
    optimizers = {name: torch.optim.Adam([value], lr=3e-3) for name, value in params.items()}
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state()
    if "count" in state:
        state["count"] = torch.zeros(len(params["means"]), dtype=torch.float32)
    target = torch.rand(1, *SIZE, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)
    counts, losses = [], []
    for step in range(steps):
        image, info = render(activated(params) | cameras(dtype))
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (image - target).square().mean()
        loss.backward()
        (after or strategy.step_post_backward)(params, optimizers, state, step, info)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        counts.append(len(params["means"]))
        losses.append(loss.item())
    return counts, losses, state


def kgs_render(**options):
    def render(values):
        renders, _, info = rasterization(**values, width=SIZE[1], height=SIZE[0], **EXACT, **options)
        return renders, info

    return render


def own_render(values):
    renders, _, info = gsplat_render(values, SIZE)
    return renders, info


@pytest.fixture
def _in_float64():
    """gsplat's strategy draws and keeps numbers in torch's default dtype."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.usefixtures("_in_float64")
@pytest.mark.parametrize(
    ("packed", "absgrad", "steps"),
    [
        (True, True, 60),
        (False, False, 60),
        *(pytest.param(*flags, 300, marks=pytest.mark.slow) for flags in product((True, False), repeat=2)),
    ],
)
def test_default_strategy_trains_as_on_gsplats_projection(packed, absgrad, steps):
    """It splits, duplicates, prunes by opacity and by size in the image, resets: the same numbers of Gaussians."""
    rules = {"refine_start_iter": 5, "refine_every": steps // 12, "refine_scale2d_stop_iter": steps, "reset_every": 30}
    rules |= {"grow_grad2d": 0.02 if absgrad else 0.008, "grow_scale2d": 0.6, "prune_scale2d": 0.9, "prune_opa": 0.3}

    def reset(params, optimizers, state, step):  # in 1.5.3 the strategy's own condition is never true
        if step % (steps // 3) == steps // 6:
            ops.reset_opa(params, optimizers, state, value=0.6)

    def own_step(params, optimizers, state, step, info):
        if absgrad:
            info["means2d"].absgrad = info["centres"].grad.abs().sum(2)
        strategy.step_post_backward(params, optimizers, state, step, info)
        reset(params, optimizers, state, step)

    def kgs_step(params, optimizers, state, step, info):
        strategy.step_post_backward(params, optimizers, state, step, info, packed=packed)
        reset(params, optimizers, state, step)

    strategy = strategies.DefaultStrategy(absgrad=absgrad, **rules)
    expected, losses, wanted = train(strategy, own_render, steps, own_step)
    counts, again, state = train(strategy, kgs_render(packed=packed, absgrad=absgrad), steps, kgs_step)
    changes = [b - a for a, b in pairwise(expected)]
    assert max(changes) > 0 > min(changes)
    assert counts == expected
    assert again == pytest.approx(losses, rel=1e-6)
    assert losses[-1] < losses[0]
    for name in ("grad2d", "count", "radii"):
        assert torch.allclose(state[name], wanted[name], rtol=1e-5)


def relocated(opacities, scales, ratios, binoms):
    """Equation 9 of Kheradmand et al. 2024, as gsplat's CUDA function `compute_relocation`."""
    ratios.clamp_(1, len(binoms))
    new = 1 - (1 - opacities) ** (1 / ratios)
    total = torch.zeros_like(opacities)
    for i in range(1, int(ratios.max()) + 1):
        for k in range(i):
            term = binoms[i - 1, k] * (-1) ** k / (k + 1) ** 0.5 * new ** (k + 1)
            total += term * (ratios >= i)
    return new, (opacities / total)[:, None] * scales


def train_with_mcmc():
    options = {"refine_start_iter": 10, "refine_every": 10, "min_opacity": 0.15, "noise_lr": 1.0}
    strategy = strategies.MCMCStrategy(cap_max=60, **options)

    def step(*given):
        strategy.step_post_backward(*given, lr=3e-3)

    counts, losses, _ = train(strategy, kgs_render(), 150, step, torch.float32)
    assert counts[0] == 40
    assert counts[-1] == 60
    assert losses[-1] < 0.8 * losses[0]


@pytest.mark.slow
def test_mcmc_strategy_trains(monkeypatch):
    """On a CPU, with torch in place of its two functions in CUDA."""
    monkeypatch.setattr(ops, "compute_relocation", relocated)
    monkeypatch.setattr(
        ops,
        "quat_scale_to_covar_preci",
        lambda quats, scales, **options: _torch_impl._quat_scale_to_covar_preci(quats, scales, **options),
    )
    train_with_mcmc()


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_mcmc_strategy_trains_with_gsplats_own_functions():
    pytest.importorskip("gsplat.csrc", reason="gsplat was built without its extension")
    with torch.device("cuda"):
        train_with_mcmc()
