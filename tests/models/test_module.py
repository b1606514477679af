"""A camera is a torch module like any other: compiled, transformed, exported, copied, saved, learned, predicted."""

import copy
import pickle
import re

import pytest
import torch
from cameras import KEYS, Unproject, each_kind, every_model, fan, make, one, pixel_lattice, slow_unless, spread
from torch import nn
from torch.func import functional_call, jacfwd, jacrev, vmap

import camtorch as ct

WITHOUT_JACFWD = ("brown_conrady", "f_theta_backward_sheared", "f_theta_sheared", "fisheye62", "fisheye624", "mei")
WITHOUT_JACFWD += ("ocamcalib", "splined", "thin_prism_fisheye")
both_directions = pytest.mark.parametrize("method", ["project", "unproject"])


def module_and_input(key, method, dtype=torch.float64):
    """A module for one direction of a real camera, and what goes in, some of it invalid."""
    camera = one(key).to(dtype)
    if method == "project":
        return camera, fan(120, 5, 7).to(dtype)
    pixels = pixel_lattice(camera, 5, 7)
    return Unproject(camera), torch.cat((pixels, pixels[:3] * 1e4))


def assert_same(results, expected, **tolerance):
    for result, reference in zip(results, expected, strict=True):
        torch.testing.assert_close(result, reference, **tolerance)


def parameters_of(module):
    return {name: p.detach() for name, p in module.named_parameters()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "method"), [("kannala_brandt", "unproject"), ("fisheye624", "project"), ("brown_conrady", "project")]
)
def test_compile_without_graph_breaks(key, method):
    module, values = module_and_input(key, method)
    compiled = torch.compile(module, fullgraph=True, backend="aot_eager")
    gradients = []
    for function in (compiled, module):
        leaf = values.clone().requires_grad_()
        result, valid = function(leaf)
        gradients.append((result, valid, *torch.autograd.grad(result.sum(), [leaf, *module.parameters()])))
    assert_same(*gradients)


@pytest.mark.parametrize("key", slow_unless("kannala_brandt".__eq__, KEYS))
@both_directions
def test_compile_takes_every_model(key, method):
    module, values = module_and_input(key, method)
    torch._dynamo.reset()  # of which each model would count as one more change of the same function
    compiled = torch.compile(module, fullgraph=True, backend="eager")
    assert_same(compiled(values), module(values), rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")  # inductor imports what still uses it
def test_compile_to_machine_code():
    camera = one("pinhole")  # the smallest graph: inductor takes its time
    points = fan(100, 5, 7)
    compiled = torch.compile(camera, fullgraph=True)
    # contracted multiplications and additions round differently
    assert_same(compiled(points), camera(points), rtol=1e-12, atol=0)


@each_kind
@both_directions
def test_functional_calls_also_in_vmap(key, method):
    module, values = module_and_input(key, method)
    before = module(values)
    stacked = {name: torch.stack((p, 1.05 * p, 0.9 * p)) for name, p in parameters_of(module).items()}
    results = vmap(lambda parameters: functional_call(module, parameters, (values,)))(stacked)
    for i in range(3):
        changed = {name: p[i] for name, p in stacked.items()}
        fresh = copy.deepcopy(module)
        fresh.load_state_dict(changed)
        expected = fresh(values)
        assert_same(functional_call(module, changed, (values,)), expected)
        assert_same([result[i] for result in results], expected)
    assert_same(module(values), before)


@both_directions
@pytest.mark.parametrize("key", ["pinhole", "kannala_brandt", "f_theta_backward", "ocamcalib", "splined"])
def test_vmap_over_no_camera(key, method):
    module, values = module_and_input(key, method)
    none = {name: p[None][:0] for name, p in parameters_of(module).items()}
    found, valid = vmap(lambda parameters: functional_call(module, parameters, (values,)))(none)
    assert found.shape == (0, *module(values)[0].shape)
    assert valid.shape == found.shape[:-1]


@every_model
@both_directions
def test_forward_and_reverse_mode_agree(key, method):
    if torch.__version__.startswith("2.10.") and method == "unproject" and key in WITHOUT_JACFWD:
        pytest.skip("torch 2.10 fails in jacfwd of these by an assertion of its own (_fw_primal in inference mode)")
    module, values = module_and_input(key, method)

    def result(parameters, values):
        return functional_call(module, parameters, (values,))[0]

    inputs = (parameters_of(module), values[::6])
    by_row = [transform(result, argnums=(0, 1))(*inputs) for transform in (jacrev, jacfwd)]
    (reverse, reverse_by_value), (forward, forward_by_value) = by_row
    assert reverse.keys() == forward.keys()
    pairs = [(reverse[name], forward[name]) for name in reverse] + [(reverse_by_value, forward_by_value)]
    for mine, reference in pairs:
        assert reference.isfinite().all()
        # both are exact; what they round differently scales with the largest derivative
        torch.testing.assert_close(mine, reference, rtol=0, atol=1e-12 * reference.abs().max().item() + 1e-15)


@each_kind
@both_directions
def test_transforms_and_contexts_of_torch_change_nothing(key, method):
    module, values = module_and_input(key, method, torch.float32)
    expected = module(values)
    with torch.inference_mode():
        inferred = [t.clone() for t in module(values)]
    with torch.autocast("cpu", torch.bfloat16):
        assert_same(module(values), expected, rtol=0, atol=0)
    checkpointed = torch.utils.checkpoint.checkpoint(module, values, use_reentrant=False)
    for results in (inferred, checkpointed):
        assert_same(results, expected)
    checkpointed[0].sum().backward()
    module, values = module_and_input(key, method)
    assert_same(vmap(module)(values), module(values))
    grid = values[:32].unflatten(0, (4, 8))
    assert_same(vmap(vmap(module))(grid), module(grid))


@each_kind
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda c: pickle.loads(pickle.dumps(c))], ids=["deepcopy", "pickle"])
def test_copies(key, copied):
    camera = one(key)
    camera.intrinsics.requires_grad_(False)
    points = fan(100, 5, 7)
    expected = camera.project(points)
    again = copied(camera)
    assert (type(again), again.image_size) == (type(camera), camera.image_size)
    assert again.distortion_names == camera.distortion_names
    assert [p.requires_grad for p in again.parameters()] == [p.requires_grad for p in camera.parameters()]
    predicted = make(key, *(t.detach().requires_grad_() * 1 for t in (camera.intrinsics, camera.distortion)))
    for one_again in (again, copied(predicted)):
        assert_same(one_again.project(points), expected)
    with torch.no_grad():
        again.intrinsics *= 2
    assert_same(camera.project(points), expected)


def test_a_state_knows_its_model(tmp_path):
    numbers, lens = [300.0, 300.0, 319.5, 239.5], [0.1, 0.0, 0.0, 0.0]
    mine, other = (kind(numbers, lens, image_size=(480, 640)) for kind in (ct.KannalaBrandt, ct.BrownConrady))
    heads = [ct.CameraHead(4, kind, image_size=(480, 640), count=4) for kind in (ct.KannalaBrandt, ct.BrownConrady)]
    pairs = [
        (mine, other),
        (nn.Sequential(mine), nn.Sequential(other)),
        (ct.Mixed([mine, other]), ct.Mixed([other, mine])),
        (ct.Warp(mine, ct.Pinhole(numbers, image_size=(480, 640))), ct.Warp(other, mine)),
        (nn.DataParallel(mine), nn.DataParallel(other)),
        heads,
    ]
    for source, target in pairs:
        torch.save(source.state_dict(), tmp_path / "state.pt")
        for state in (copy.deepcopy(source.state_dict()), torch.load(tmp_path / "state.pt", weights_only=True)):
            assert copy.deepcopy(source).load_state_dict(state)
            before = copy.deepcopy(target.state_dict())
            with pytest.raises(RuntimeError, match=r"must be of BrownConrady; got one of KannalaBrandt"):
                target.load_state_dict(state, strict=False)
            if target is other:
                assert torch.equal(other.distortion, before["distortion"])
    other.load_state_dict(dict(mine.state_dict()))  # of safetensors, and of 0.2.0, which do not say
    assert torch.equal(other.distortion, mine.distortion)

    class Named(ct.KannalaBrandt):
        pass

    Named(numbers, lens).load_state_dict(mine.state_dict())
    assert set(mine.state_dict()) == {"intrinsics", "distortion"}


@each_kind
def test_every_change_of_a_parameter_is_noticed(key):
    """Whatever a camera keeps between calls, it follows its parameters."""
    camera, state = spread(key), spread(key).state_dict()
    assert set(state) == ({"intrinsics", "distortion"} if camera.distortion_names else {"intrinsics"})
    points, pixels = fan(60, 5, 7), pixel_lattice(camera, 4, 5)

    def check():
        fresh = make(key, camera.intrinsics.detach(), camera.distortion.detach())
        assert_same(camera.project(points), fresh.project(points))
        assert_same(camera.unproject(pixels), fresh.unproject(pixels))

    check()
    for parameter in camera.parameters():
        parameter.data.mul_(1.1)
        check()
        with torch.no_grad():
            parameter *= 1.1
        check()
        parameter.data = parameter.data * 0.9
        check()
    optimizer = torch.optim.Adam(camera.parameters(), lr=1e-2)
    camera.project(points)[0].sum().backward()
    optimizer.step()
    check()
    camera.load_state_dict(state)
    check()
    assert_same(camera.state_dict().values(), state.values())
    with pytest.raises(RuntimeError, match="intrinsics"):
        camera.load_state_dict({})


@each_kind
def test_plain_values_become_parameters(key):
    camera = spread(key)
    assert camera.intrinsics.requires_grad
    values = camera.intrinsics.tolist()
    for plain in (values, camera.intrinsics.detach().numpy(), camera.intrinsics.detach()):
        again = ct.MODELS[key](plain)
        assert isinstance(again.intrinsics, nn.Parameter)
        assert again.intrinsics is not plain
    for plain in (values, [300, 300, 320, 240], camera.intrinsics.detach().half()):
        assert ct.MODELS[key](plain).intrinsics.dtype == torch.float32
    parameter = nn.Parameter(camera.intrinsics.detach())
    assert ct.MODELS[key](parameter).intrinsics is parameter


@each_kind
def test_low_precision_networks_keep_their_geometry(key):
    network = nn.ModuleDict({"layer": nn.Linear(2, 2), "camera": one(key).float()})
    before = network["camera"].intrinsics.detach().clone()
    for moved in (network.bfloat16(), network.half(), network.to(torch.bfloat16)):
        assert moved["layer"].weight.dtype != torch.float32
        assert moved["camera"].intrinsics.dtype == torch.float32
        assert torch.equal(moved["camera"].intrinsics, before)
    assert network.double()["camera"].intrinsics.dtype == torch.float64
    assert network["camera"].distortion.dtype == torch.float64


@each_kind
@both_directions
@pytest.mark.parametrize(
    ("of_camera", "of_values", "expected"),
    [
        (torch.float32, torch.float32, torch.float32),
        (torch.float32, torch.float64, torch.float64),
        (torch.float64, torch.float32, torch.float64),
        (torch.float32, torch.bfloat16, torch.float32),
        (torch.float32, torch.int64, torch.float32),
        (torch.float64, torch.uint8, torch.float64),
    ],
)
def test_dtype_promotion(key, method, of_camera, of_values, expected):
    module, _ = module_and_input(key, method, of_camera)
    values = torch.tensor([[3, 4, 10], [1, 0, 5]] if method == "project" else [[200, 150], [180, 240]])
    result, valid = module(values.to(of_values))
    assert result.dtype == expected
    assert valid.dtype == torch.bool
    assert_same((result, valid), module(values.to(expected)))


@every_model
def test_repr(key):
    camera = spread(key)
    text = repr(camera)
    assert text.startswith(type(camera).__name__)
    assert f"fx={camera.intrinsics[0]:.6g}" in text
    assert text.endswith("image_size=(480, 640), float64, learns)")
    assert ", float32, frozen)" in repr(camera.float().requires_grad_(False))
    named = () if key == "splined" else zip(camera.distortion_names, camera.distortion.tolist(), strict=True)
    for name, value in named:  # instead of hundreds of control points there is their grid
        assert re.search(rf"\b{name}={re.escape(f'{value:.6g}')}", text)
    batched = make(key, camera.intrinsics.detach().expand(2, 4), camera.distortion.detach())
    assert "batch_shape=(2,)" in repr(batched)


@each_kind
@both_directions
@pytest.mark.parametrize("rows", [(), (2, 3)])
def test_results_may_be_edited_in_place(key, method, rows):
    """The gradient is that of the same edits made out of place."""
    _, values = module_and_input(key, method)
    values, camera = values.expand(*rows, -1, -1), one(key)
    gradients = []
    for in_place in (True, False):
        leaves = [p.detach().clone().requires_grad_() for p in camera.parameters()]
        points = values.clone().requires_grad_()
        result, valid = getattr(type(camera)(*leaves), method)(points)
        keep = torch.arange(valid.shape[-1]) % 3 > 0
        weights = torch.linspace(-1, 2, result.numel(), dtype=result.dtype).view_as(result)
        if in_place:
            valid &= keep
            result *= weights
            result[..., 0] += 1.0
            result[~valid] = 7.0
            valid |= True
        else:
            result = torch.where((valid & keep)[..., None], result * weights + torch.eye(result.shape[-1])[0], 7.0)
        result.square().sum().backward()
        gradients.append([points.grad, *(leaf.grad for leaf in leaves)])
    for edited, expected in zip(*gradients, strict=True):
        torch.testing.assert_close(edited, expected, rtol=1e-9, atol=1e-9)
