"""What users pass to calibration: every form that corners come in, and errors that say what to do."""

import re

import numpy as np
import pytest
import torch
from boards import chessboard

from camtorch.calibration.observations import as_observations, as_rig_observations

SIZE = (480, 640)
OWNER = "calibrate"


def board(columns=9, rows=6, square=0.025):
    """(N, 3): the inner corners of a chessboard, as OpenCV takes them."""
    return chessboard(columns, rows, square).float().numpy()


def refuses(*words, error=ValueError):
    """The error, and a message in which all the words appear in this order."""
    return pytest.raises(error, match=re.compile(".*".join(map(re.escape, (OWNER, *words))), re.DOTALL))


def same(found, expected_points, expected_pixels):
    for t, expected in zip(found[:2], (expected_points, expected_pixels), strict=True):
        assert t.dtype == torch.float64
        torch.testing.assert_close(t, torch.as_tensor(expected).double(), rtol=0, atol=0)


BOARD, PLACES = board(), np.linspace(0, 1, 5)
# the board here and there in the image, to its rim
VIEWS = np.stack([board(square=1.0)[:, :2] * (30 + 5 * s) + [340 * s + 20, 200 * s + 10] for s in PLACES])
VIEWS = VIEWS.astype(np.float32)
REPEATED = np.repeat(BOARD[None], len(VIEWS), 0)


@pytest.mark.parametrize(
    "object_points",
    [
        *(BOARD, torch.from_numpy(BOARD), BOARD.tolist(), BOARD[:, None], BOARD[None], [BOARD], REPEATED),
        *([BOARD] * 5, [BOARD[:, None]] * 5, [BOARD[None]] * 5, tuple(torch.from_numpy(BOARD) for _ in range(5))),
        torch.from_numpy(BOARD).requires_grad_(),
    ],
)
def test_forms_of_object_points(object_points):
    same(as_observations(object_points, VIEWS, SIZE, OWNER)[0], REPEATED, VIEWS)


FORMS = [VIEWS, VIEWS[:, :, None], VIEWS[:, None], torch.from_numpy(VIEWS), torch.from_numpy(VIEWS).double()]
FORMS += [torch.from_numpy(VIEWS).requires_grad_(), VIEWS.tolist(), list(VIEWS), tuple(torch.from_numpy(VIEWS))]
FORMS += [[v[:, None] for v in VIEWS], [v[None] for v in VIEWS]]


@pytest.mark.parametrize("image_points", FORMS)
def test_forms_of_image_points_and_back(image_points):
    observations, layout = as_observations(BOARD, image_points, SIZE, OWNER)
    same(observations, REPEATED, VIEWS)
    assert not observations.pixels.requires_grad
    assert observations.seen.all()
    assert layout.image_size == SIZE
    for values, size in ((observations.pixels, (2,)), (observations.seen, ()), (observations.pixels[..., 0], ())):
        back = layout.restore(values, observations.seen)
        assert isinstance(back, torch.Tensor if isinstance(image_points, (torch.Tensor, np.ndarray)) else list)
        for one, view, value in zip(back, image_points, values, strict=True):
            assert tuple(one.shape) == (*np.shape(np.asarray(view) if isinstance(view, list) else view)[:-1], *size)
            assert one.dtype == values.dtype
            torch.testing.assert_close(one.reshape(value.shape), value, rtol=0, atol=0)


def test_numbers_of_all_kinds():
    whole, half, far = VIEWS.astype(np.int32), torch.from_numpy(VIEWS).half(), BOARD + np.array([1e6, 0, 0])
    for points, pixels in ((BOARD, whole), (BOARD, half), (far, VIEWS)):
        same(as_observations(points, pixels, SIZE, OWNER)[0], np.repeat(points[None], 5, 0), pixels)


def test_nan_is_unseen_and_boards_may_lack_what_is_unseen():
    image_points, points = VIEWS.copy(), REPEATED.copy()
    image_points[1, 5:7] = image_points[0, 2] = image_points[1, 7, 0] = points[1, 5] = np.nan
    observations, layout = as_observations(points, image_points, SIZE, OWNER)
    assert (~observations.seen).nonzero().tolist() == [[0, 2], [1, 5], [1, 6], [1, 7]]
    assert (observations.pixels[1, 5:8] == 0).all()
    assert (observations.points[1, 5] == 0).all()
    back, inliers = (layout.restore(t, observations.seen) for t in (observations.pixels, observations.seen | True))
    assert back[1][5:8].isnan().all()
    assert not inliers[1][5:8].any()


@pytest.mark.parametrize("empty", [None, np.empty((0, 2), np.float32), [], np.full((54, 2), np.nan)])
def test_views_without_corners_are_left_out(empty):
    image_points = [VIEWS[0], empty, VIEWS[2], VIEWS[3], empty]
    with pytest.warns(UserWarning, match=r"views 1, 4 left out, because") as caught:
        observations, layout = as_observations([BOARD] * 5, image_points, SIZE, OWNER)
    assert len(caught) == 1
    assert layout.views.tolist() == [0, 2, 3]
    same(observations, REPEATED[:3], VIEWS[[0, 2, 3]])
    back = layout.restore(observations.pixels, observations.seen)
    assert len(back) == 5
    assert back[1].isnan().all()
    assert tuple(back[1].shape) == (np.shape(empty)[0] if empty is not None else 54, 2)


def test_views_of_different_corners():
    which = [np.arange(54), np.arange(10, 40), np.arange(0, 54, 3)]
    points, image_points = [BOARD[w] for w in which], [VIEWS[i][w][:, None] for i, w in enumerate(which)]
    observations, layout = as_observations(points, image_points, SIZE, OWNER)
    assert observations.seen.sum(-1).tolist() == [54, 30, 18]
    assert observations.seen.shape == (3, 54)
    for back, given in zip(layout.restore(observations.pixels, observations.seen), image_points, strict=True):
        torch.testing.assert_close(back, torch.from_numpy(given).double(), rtol=0, atol=0)
    inliers = layout.restore(observations.seen, observations.seen)
    assert [tuple(t.shape) for t in inliers] == [(54, 1), (30, 1), (18, 1)]
    points[1] = None
    image_points[1] = None
    with pytest.warns(UserWarning, match="view 1"):
        assert len(as_observations(points, image_points, SIZE, OWNER)[0].seen) == 2


def changed(index, value):
    image_points = VIEWS.copy()
    image_points[index] = value
    return image_points


BAD = {
    "one view": (BOARD, VIEWS[0], ["image_points", "(V, N, 2)", "(54, 2)"]),
    "no view": (BOARD, [], ["image_points", "must have a view"]),
    "nan": (BOARD, np.full_like(VIEWS, np.nan), ["got NaN in all views"]),
    "empty": (BOARD, [np.empty((0, 2))] * 3, ["must have seen corners"]),
    "few corners": (BOARD, changed((2, slice(3, None)), np.nan), ["view 2", "4 or more seen corners"]),
    "swapped axes": (BOARD, VIEWS.swapaxes(1, 2), ["image_points", "(V, N, 2)", "(5, 2, 54)"]),
    "rows and columns": (BOARD, VIEWS[..., ::-1], ["in the image of", "(480, 640)", "points are (u, v)"]),
    "board size": (board(8, 6), VIEWS, ["view 0", "48 (inner", "got 54"]),
    "number of views": ([BOARD] * 4, VIEWS, ["'image_points': 5", "'object_points': 4"]),
    "exchanged": (VIEWS, REPEATED, ["image_points", "(V, N, 2)", "(5, 54, 3)"]),
    "no z": (BOARD[:, :2], VIEWS, ["object_points", "(N, 3)", "(54, 2)"]),
    "one point": (0 * BOARD, VIEWS, ["object_points", "one point"]),
    "a line": (BOARD * np.float32([1, 0, 0]), VIEWS, ["object_points", "one line"]),
    "a line in one view": (BOARD, changed((3, slice(9, None)), np.nan), ["view 3", "one line"]),
    "pixels at zero": (BOARD, changed((1, slice(0, 3)), 0.0), ["view 1", "NaN", "got (0, 0)"]),
    "infinite": (BOARD, changed((2, 7), np.inf), ["view 2", "image_points", "finite", "NaN"]),
    "an infinite corner": (np.where(BOARD[-1] == BOARD, np.inf, BOARD), VIEWS, ["object_points", "finite"]),
    "a board without a corner": (np.where(BOARD[-1] == BOARD, np.nan, BOARD), VIEWS, ["object_points", "finite"]),
    "normalised": (BOARD, VIEWS / 640, ["pixels in the image", "from (0.03125, 0.015625) to (1, 0.601562)"]),
    "outside": (BOARD, VIEWS * 3, ["image_points must be pixels in", "(480, 640)", "corners outside"]),
    "another size in one view": (BOARD, changed(4, VIEWS[4] * 2), ["outside", "in view 4", "all images"]),
    "ragged": (BOARD, [[[1.0, 2.0], [3.0]]] * 5, ["image_points[0]"]),
}


@pytest.mark.parametrize(("object_points", "image_points", "words"), [*BAD.values()], ids=[*BAD])
def test_bad_points(object_points, image_points, words):
    with refuses(*words):
        as_observations(object_points, image_points, SIZE, OWNER)


NO_POINTS = [
    (BOARD, None, ["image_points", "NoneType"]),
    (None, VIEWS, ["object_points", "NoneType"]),
    (BOARD, ["a.jpg", "b.jpg"], ["image_points[0]", "tensor", "str"]),
    (BOARD, {"left": VIEWS}, ["image_points", "dict"]),
    (BOARD, VIEWS > 0, ["image_points", "bool"]),
    (BOARD, torch.from_numpy(VIEWS) + 0j, ["image_points", "complex"]),
]


@pytest.mark.parametrize(("object_points", "image_points", "words"), NO_POINTS)
def test_what_is_no_points(object_points, image_points, words):
    with refuses(*words, error=TypeError):
        as_observations(object_points, image_points, SIZE, OWNER)


def test_sizes_of_images():
    for size in ((480, 640), [480, 640], np.array([480, 640]), torch.Size(SIZE)):
        assert as_observations(BOARD, VIEWS, size, OWNER)[1].image_size == SIZE
    with refuses("image_size", "(640, 480)", "is (height, width)"):
        as_observations(BOARD, VIEWS, (640, 480), OWNER)
    with refuses("image_size", "(height, width)", "None", error=TypeError):
        as_observations(BOARD, VIEWS, None, OWNER)


def test_corners_at_the_rim_and_a_few_outliers_are_taken():
    image_points = VIEWS.copy()
    image_points[0, 0] = -3.0  # just outside
    image_points[:, :3] += 300.0  # gross outliers, some of them outside
    assert as_observations(BOARD, image_points, SIZE, OWNER)[0].seen.all()


MODELS = {"left": "kannala_brandt", "right": "kannala_brandt"}
SIZES = {"left": SIZE, "right": (600, 800)}


def test_cameras_of_a_rig_see_the_same_boards():
    right = [None, *VIEWS[1:4], np.full((54, 2), np.nan)]
    left = VIEWS.copy()
    left[4] = np.nan
    left[2, 5] = np.nan
    points = {"right": right, "left": left}  # in another order than the models
    with pytest.warns(UserWarning, match="view 4 left out"):
        found = as_rig_observations(BOARD, points, SIZES, MODELS, OWNER)
    assert list(found) == ["left", "right"]
    for observations, _ in found.values():
        assert observations.points.tolist() == REPEATED[:4].tolist()
    (left_seen, left_layout), (right_seen, right_layout) = found.values()
    assert left_seen.seen.sum(-1).tolist() == [54, 54, 53, 54]
    assert right_seen.seen.sum(-1).tolist() == [0, 54, 54, 54]
    assert right_layout.image_size == (600, 800)
    back = left_layout.restore(left_seen.pixels, left_seen.seen)
    torch.testing.assert_close(back, torch.from_numpy(left).double(), rtol=0, atol=0, equal_nan=True)
    back = right_layout.restore(right_seen.pixels, right_seen.seen)
    assert [tuple(t.shape) for t in back] == [(54, 2)] * 5
    assert [bool(t.isnan().any()) for t in back] == [True, False, False, False, True]


def rig(left, right):
    return {"image_points": {"left": left, "right": right}}


BAD_RIGS = [
    ({"image_points": {"left": VIEWS}}, ["same names", "image_points of ['left']"]),
    ({"image_sizes": {"left": SIZE, "rihgt": SIZE}}, ["same names", "got image_sizes of ['left', 'rihgt']"]),
    ({"models": {"left": "mei"}}, ["same names", "image_points of ['left', 'right']"]),
    ({"models": {}}, ["same names", "got models of []"]),
    (rig(VIEWS, VIEWS[:4]), ["same views", "left", "5", "right", "4"]),
    (rig(VIEWS, [None] * 5), ["right", "must have a view"]),
    (rig(VIEWS, VIEWS * np.nan), ["right", "NaN in all views"]),
    ({"image_sizes": {"left": SIZE, "right": (640, 480)}}, ["right", "image_size is (height, width)"]),
    (rig(VIEWS, VIEWS[:, :48]), ["right: view 0", "54", "48"]),
    (rig(VIEWS, changed((1, slice(2, None)), np.nan)), ["right: view 1", "image_points"]),
    (rig([*VIEWS[:3], None, None], [None, None, None, *VIEWS[3:]]), ["share views with 'left'", "view of 'right'"]),
    ({"image_points": [VIEWS, VIEWS]}, ["names of cameras", "list"]),
]


@pytest.mark.parametrize(("changes", "words"), BAD_RIGS)
def test_bad_rigs(changes, words):
    given = {**rig(VIEWS, VIEWS), "image_sizes": SIZES, "models": MODELS, **changes}
    with refuses(*words, error=TypeError if "names of cameras" in words else ValueError):
        as_rig_observations(BOARD, owner=OWNER, **given)


def test_cameras_linked_by_another():
    points = {"a": [*VIEWS[:2], None, None], "b": [None, None, *VIEWS[2:4]], "c": [None, VIEWS[1], VIEWS[2], None]}
    found = as_rig_observations(BOARD, points, dict.fromkeys("abc", SIZE), dict.fromkeys("abc"), OWNER)
    assert [seen.seen.any(-1).sum().item() for seen, _ in found.values()] == [2, 2, 2]
