"""Devices: results on a pretended one are those of the CPU, a mix is refused, and no name is forgotten."""

import copy
import operator
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from pretended import try_cases
from table import BROWN, CASES, DEPTH, FISHEYE, IMAGES, PIXELS, POINTS, POSE, SHUTTER

import camtorch as ct
from camtorch import augment, losses, views

OTHERS = {
    *("calibrate", "calibrate_rig", "find_board", "from_kornia", "load", "loads", "load_map", "save", "save_map"),
    *["write_viewer", "LookupMap", "CameraFileError", "FisheyeRadTanThinPrism"],
    *("augment.Augmentation", "augment.Change", "augment.Edit"),
    *("augment.Preset", "augment.Range", "augment.face_points", "views.Views"),
}
"""Names that compute on the host, of files and boards; other names of what is in the table, and its bases and parts."""


def test_every_public_name_is_in_the_table():
    modules = {"": ct, "augment.": augment, "losses.": losses, "views.": views}
    public = {prefix + name for prefix, module in modules.items() for name in module.__all__}
    found = {name for name in public if callable(operator.attrgetter(name)(ct))}
    assert found - {name.partition(" ")[0] for name in CASES} == OTHERS


@pytest.mark.slow  # ten seconds
def test_results_are_those_of_the_cpu_and_costs_do_not_grow():
    failed, table = try_cases("table")
    print(table)
    assert not failed, table


@pytest.mark.slow
def test_cameras_warps_and_augmentations_do_without_float64():
    subprocess.run([sys.executable, Path(__file__).with_name("without_float64.py")], check=True)


K = FISHEYE.distortion.detach()
MIXED = {
    "distortion": lambda to: ct.KannalaBrandt(to(FISHEYE).intrinsics.detach(), K),
    "replace": lambda to: to(FISHEYE).replace(distortion=K),
    "cat": lambda to: ct.cat([to(FISHEYE), FISHEYE]),
    "project": lambda to: to(FISHEYE).project(POINTS),
    "backproject": lambda to: FISHEYE.backproject(to(DEPTH)),
    "translation": lambda to: ct.Extrinsics(to(torch.zeros(3)), torch.zeros(3)),
    "Warp": lambda to: ct.Warp(to(FISHEYE), BROWN),
    "rotation": lambda to: ct.Dewarp(to(FISHEYE), rotation=torch.eye(3)),
    "images": lambda to: ct.Dewarp(to(FISHEYE))(IMAGES),
    "normal": lambda to: ct.PlaneWarp(to(BROWN), to(BROWN), to(POSE), torch.ones(3), 2.0),
    "shutter": lambda to: ct.ShutterWarp(to(FISHEYE), to(BROWN), shutter=SHUTTER),
    "triangulate": lambda to: ct.triangulate([to(FISHEYE)] * 2, [to(POSE), POSE], to(PIXELS)),
    "solve_pnp": lambda to: ct.solve_pnp(to(FISHEYE), POINTS, to(PIXELS)),
    "fit": lambda to: ct.fit("kannala_brandt", to(PIXELS), POINTS),
    "angles": lambda to: losses.angles(to(POINTS), POINTS),
    "a sample": lambda to: augment.HorizontalFlip()(image=to(IMAGES), keypoints=PIXELS),
}


@pytest.mark.parametrize("call", MIXED.values(), ids=MIXED)
def test_a_mix_of_devices_is_refused(call):
    with pytest.raises(ValueError, match=r"(meta.*cpu|cpu.*meta).*\. Move (it|them) with \.to\(device\)"):
        call(lambda value: copy.deepcopy(value).to("meta"))
