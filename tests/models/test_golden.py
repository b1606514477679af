"""Agreement with the reference numbers in golden/ (see its README)."""

import pytest
import torch
from cameras import GOLDEN, golden_camera, tensor
from torch.func import functional_call, jacrev

import camtorch as ct

every_file = pytest.mark.parametrize("name", GOLDEN)
files_with_jacobians = pytest.mark.parametrize("name", [name for name in GOLDEN if name.startswith("mpmath")])
EPS = torch.finfo(torch.float64).eps


def beyond(error, limit):
    return (error / limit).max().item()


@every_file
def test_projection(name):
    case = GOLDEN[name]
    pixels, valid = golden_camera(case).project(tensor(case["points"]))
    judged = torch.tensor([answer is not None for answer in case["valid"]])
    expected = torch.tensor([bool(answer) for answer in case["valid"]])
    assert (valid == expected)[judged].all(), tensor(case["points"])[judged & (valid != expected)]
    reference = tensor(case["pixels"])[judged & expected]
    limit = 1e-9 * (reference.norm(dim=-1) / 1000).clamp(min=1)
    assert beyond((pixels[judged & expected] - reference).norm(dim=-1), limit) < 1


@every_file
def test_unprojection(name):
    case = GOLDEN[name]["unproject"]
    pixels, reference, rad_per_px = tensor(case["pixels"]), tensor(case["rays"]), tensor(case["rad_per_px"])
    rays, valid = golden_camera(GOLDEN[name]).unproject(pixels)
    reachable = reference.isfinite().all(-1)
    assert (valid == reachable).all(), pixels[valid != reachable]
    # four roundings of the pixel, seen through the conditioning of the ray
    limit = (4 * EPS * pixels.norm(dim=-1) * rad_per_px).clamp(min=case["ray_tolerance"])
    assert beyond((rays - reference).norm(dim=-1)[reachable], limit[reachable]) < 1
    assert torch.allclose(rays.norm(dim=-1), torch.ones(len(rays), dtype=rays.dtype), rtol=0, atol=4 * EPS)


def jacobians(case):
    """d(pixel)/d(point) (N, 2, 3) and d(pixel)/d(parameters) (N, 2, P) by autograd."""
    points, parameters = tensor(case["points"]), tensor(case["parameters"])
    general = case["family"] == "kannala_brandt_general"
    camera = golden_camera(case)

    def project(point, parameters):
        if general:
            return ct.KannalaBrandt.from_general(parameters[:4], parameters[4:]).project(point)[0]
        return functional_call(camera, {"intrinsics": parameters[:4], "distortion": parameters[4:]}, (point,))[0]

    return torch.func.vmap(jacrev(project, argnums=(0, 1)), in_dims=(0, None))(points, parameters)


@files_with_jacobians
def test_jacobians(name):
    case = GOLDEN[name]
    by_point, by_parameter = jacobians(case)
    valid = torch.tensor(case["valid"])
    for result, file in ((by_point, "points"), (by_parameter, "parameters")):
        reference = tensor(case["jacobian"][file])
        assert (result[~valid] == 0).all()
        # relative to the column: how much this one coordinate moves the pixel; and a rounding of the focal length,
        # for the columns that are zero on the axis
        limit = 1e-8 * reference[valid].norm(dim=-2, keepdim=True) + EPS * golden_camera(case).intrinsics.max()
        assert beyond((result - reference)[valid].abs(), limit) < 1
