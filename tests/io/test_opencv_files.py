import pickle

import pytest
import torch
from rigs import FAULTS, FILES, written

import camtorch as ct
from camtorch.io import CameraFileError, opencv

K = [500.0, 0, 320, 0, 500, 240, 0, 0, 1]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "camera.yml"


def test_old_header_other_names_and_what_is_not_asked_for_may_be_nan():
    camera = opencv.read(FILES / "opencv_old.yml")
    assert type(camera) is ct.BrownConrady
    assert camera.intrinsics.tolist() == [501.25, 501.5, 320.75, 239.5]
    assert camera.distortion.tolist() == [0.125, -0.25, 0.0005, -0.00025, 0.0625, 0.25, -0.125, 0.03125]
    assert camera.image_size == (480, 640)


def test_a_pair_that_is_height_and_width_is_warned_of():
    assert ct.loads(f"K: {K}\nimage_size: [640, 480]\n").camera.image_size == (480, 640)
    with pytest.warns(UserWarning, match=r"loads: image_size=\(480, 640\) is .* the middle of \(640, 480\)"):
        ct.loads(f"K: {K}\nimage_size: [480, 640]\n")


@pytest.mark.parametrize("suffix", [".yml", ".json", ".xml"])
@pytest.mark.parametrize("xi", ["1.25", "[1.25]", "!!opencv-matrix {rows: 1, cols: 1, dt: d, data: [1.25]}"])
def test_omnidir(tmp_path, suffix, xi):
    """What cv2.omnidir calibrates has an xi beside it, a number or a matrix."""
    path = written(tmp_path / "omnidir.yml", f"K: {K}\nD: [0.1, 0.01, 0.001, 0.0001]\nxi: {xi}\n")
    camera = ct.load(path).camera
    assert type(camera) is ct.Mei
    assert camera.distortion.tolist() == [1.25, 0.1, 0.01, 0.001, 0.0001]
    ct.save(camera, tmp_path / f"again{suffix}", "opencv")
    again = ct.load(tmp_path / f"again{suffix}").camera
    assert type(again) is ct.Mei
    assert torch.equal(again.distortion, camera.distortion)


@pytest.mark.parametrize("keys", [("R", "T"), ("om", "T"), ("rvec", "tvec")])
def test_an_omnidir_pair_is_posed_by_matrices_and_by_vectors(path, keys):
    of_one = "camera_matrix_{0}: {1}\ndistortion_coefficients_{0}: [0.1, 0.01, 0.001, {0}]\nxi_{0}: {0}.5\n"
    text = "".join(of_one.format(i, K) for i in (1, 2))
    turn, shift = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64), [1.0, 2, 3]
    pose = ct.Extrinsics(turn, torch.tensor(shift, dtype=torch.float64))
    rotation = pose.matrix()[:3, :3].flatten().tolist() if keys[0] == "R" else turn.tolist()
    rig = ct.loads(text + f"{keys[0]}: {rotation}\n{keys[1]}: {shift}\n")
    lenses = [camera.distortion.tolist() for camera in rig.cameras.values()]
    assert lenses == [[1.5, 0.1, 0.01, 0.001, 1.0], [2.5, 0.1, 0.01, 0.001, 2.0]]
    torch.testing.assert_close(rig.between("1", "2").matrix(), pose.matrix(), rtol=0, atol=1e-15)
    ct.save(rig, path)
    assert [camera.distortion.tolist() for camera in ct.load(path).cameras.values()] == lenses


@pytest.mark.parametrize("key", ["distCoeff", "dist_coef", "d", "distCoeffsMat", "distortion_parameters", "dist"])
def test_distortion_by_many_names(key):
    assert ct.loads(f"K: {K}\n{key}: [[0.3, 0.1, 0, 0, 0]]").camera.distortion.shape == (5,)


def test_what_opencvs_own_programs_write_besides():
    """interactive-calibration, and others: statistics are no distortion."""
    text = f"""cameraResolution: [640, 480]
cameraMatrix: {K}
cameraMatrix_std_dev: [1, 1, 1, 1]
dist_coeffs: [0.3, 0.1, 0, 0, 0]
dist_coeffs_std_dev: [1, 1, 1, 1, 1]
undistorted_image_size: [640, 480]
correlation_coefficients: [1, 2]
avg_reprojection_error: 0.2
"""
    camera = ct.loads(text).camera
    assert camera.distortion.tolist() == [0.3, 0.1, 0, 0, 0]
    assert camera.image_size == (480, 640)
    assert ct.loads(f"camera_matrix: [{K[:3]}, {K[3:6]}, {K[6:]}]\n").camera.image_size is None
    without = f"K: {K}\nundistorted_points: [1]\ndist_std_dev: [1]\ndistortion_names: [k1]\n"
    assert type(ct.loads(without).camera) is ct.Pinhole


def test_arrays_of_one_dimension():
    yaml = f"%YAML:1.0\n---\nK: {K}\nD: !!opencv-nd-matrix\n   sizes: [ 5 ]\n   dt: d\n   data: [ 0.3, 0.1, 0, 0, 0 ]\n"
    whole = {"K": K, "D": {"type_id": "opencv-nd-matrix", "sizes": [5], "dt": "d", "data": [0.3, 0.1, 0, 0, 0]}}
    xml = (
        "<?xml version='1.0'?><opencv_storage><K type_id='opencv-matrix'><rows>3</rows><cols>3</cols><dt>d</dt>"
        f"<data>{' '.join(map(str, K))}</data></K><D type_id='opencv-nd-matrix'><sizes>5</sizes><dt>d</dt>"
        "<data>0.3 0.1 0 0 0</data></D></opencv_storage>"
    )
    for content in (yaml, whole, xml):
        assert ct.loads(content).camera.distortion.tolist() == [0.3, 0.1, 0, 0, 0]
    with pytest.raises(CameraFileError, match=r"D.data: must have 6 numbers, by sizes; got 5"):
        ct.loads(yaml.replace("[ 5 ]", "[ 6 ]"))


def test_model_argument_decides(path):
    written(path, f"K: {K}\nD: [0.1, 0.01, 0.001, 0.0001]\n")
    assert type(opencv.read(path, "kannala_brandt")) is ct.KannalaBrandt
    with pytest.raises(CameraFileError, match=r"D: Pinhole must have coefficients n = 0"):
        opencv.read(path, "pinhole")
    with pytest.raises(ValueError, match=r"model must be one of brown_conrady, .*pinhole.*; got 'fish'"):
        opencv.read(path, "fish")


def test_several_cameras_are_a_rig(path):
    assert opencv.read_rig(FILES / "opencv_stereo.yml")["2"].intrinsics.tolist() == [1064.3, 1065.1, 641.7, 396.4]
    pose = "R: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nT: [1, 0, 0]\n"
    written(path, f"K1: {K}\nK2: {K}\nD1: [0.1, 0, 0, 0]\nD2: [0.1, 0, 0, 0]\n{pose}")
    rig = opencv.read_rig(path, "kannala_brandt")
    assert [camera.key for camera in rig.cameras.values()] == ["kannala_brandt"] * 2
    assert list(rig.extrinsics) == ["1", "2"]
    assert not any(p.requires_grad for p in rig.parameters())


@pytest.mark.parametrize(("text", "told"), dict(FAULTS)["camera.yml"])
def test_every_fault_has_a_place_and_a_reason(path, text, told):
    with pytest.raises(CameraFileError, match=rf"(?s)camera.yml: {told}") as caught:
        opencv.read(written(path, text.replace("$K", str(K)).replace(r"\n", "\n").replace(r"\0", "\0")))
    assert pickle.loads(pickle.dumps(caught.value)).args == caught.value.args


D4 = "D: [0.1, 0.01, 0.001, 0.0001]\n"


@pytest.mark.parametrize(
    ("text", "stated", "other"),
    [
        *((f"fisheye_model: {yes}\n{D4}", "kannala_brandt", "brown_conrady") for yes in ("1", "true", "1.")),
        *((f"fisheye_model: {no}\n{D4}", "brown_conrady", "kannala_brandt") for no in ("0", "No", "0.0")),
        ("fisheye_model: 0\n", "pinhole", "kannala_brandt"),
        (f"xi: 1.2\n{D4}", "mei", "ucm"),
    ],
)
def test_a_file_that_states_its_model_is_not_overruled(path, text, stated, other):
    written(path, f"K: {K}\n{text}")
    assert opencv.read(path, stated).key == opencv.read(path).key == stated
    with pytest.raises(CameraFileError, match=f"model must be the file's, .*; got {other}. Leave it out"):
        opencv.read(path, other)
