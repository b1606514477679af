"""The recipe for a camera on a robot, as the guide has it, finds the camera where it is."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from boards import seen_by

import camtorch as ct

GUIDE = (Path(__file__).parents[2] / "docs" / "guides" / "calibration.md").read_text()
RECIPE, OPENCV = re.findall(r"^```pyt?h?o?n?\n([^`]*hands\[[^`]*)^```", GUIDE, re.M)
NUMBERS = [600.0, 602.0, 321.0, 238.0], [-0.1, 0.02, 1e-3, -5e-4, 0.0]
CAMERA = ct.BrownConrady(*(torch.tensor(v).double() for v in NUMBERS), image_size=(480, 640)).requires_grad_(False)


@pytest.mark.parametrize(("noise", "angle", "distance"), [(0.0, 1e-8, 1e-8), (0.1, 2e-3, 5e-3)])
@pytest.mark.parametrize("eye", ["in_hand", "beside"])
def test_the_camera_is_found_where_it_is(eye, noise, angle, distance, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    corners, turns, shifts = seen_by(CAMERA, 12, noise=noise, near=0.2, far=0.45)
    boards = ct.Extrinsics.from_matrix(turns, shifts).matrix().detach()
    draw = torch.randn(4, 3, generator=torch.Generator().manual_seed(100)).double()
    truth, world = (ct.Extrinsics(*pair).matrix().detach() for pair in (draw[:2], draw[2:]))
    motions = torch.linalg.inv(truth) @ boards @ torch.linalg.inv(world)  # camera from board: truth, this, world
    points, pixels = corners[:2]
    robot = {"object_points": points, "image_points": pixels, "base_from_hand": torch.linalg.inv(motions)}
    np.savez("robot.npz", **robot)
    ct.save(CAMERA, "camera.yml", format="opencv")
    code = RECIPE  # of a camera in the hand
    if eye == "beside":  # the board is on the hand
        np.savez("robot.npz", **robot | {"base_from_hand": motions})
        code = re.sub(r"(hands = torch.tensor\(.*?\]\))", r"\1.inverse()", code)
    found = {}
    exec(code, found)
    off = found["camera_from_hand"].compose(ct.Extrinsics.from_matrix(truth).inverse())
    assert off.rotation.norm() < angle
    assert (found["camera_from_hand"].translation - truth[:3, 3]).norm() < distance
    if hasattr(cv2, "calibrateHandEye"):  # OpenCV 4
        exec("import cv2\n" + OPENCV, found)
        theirs = ct.Extrinsics.from_matrix(found["R"], found["t"][:, 0]).inverse().matrix()
        near = {"rtol": 0, "atol": 1e-6 + 2 * distance * bool(noise)}
        torch.testing.assert_close(found["camera_from_hand"].matrix(), theirs, **near)
