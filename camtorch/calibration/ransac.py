"""The pose on which most of the seen points agree, by samples of three: RANSAC on rays of any angle."""

from __future__ import annotations

import ctypes
import struct
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from camtorch._threads import spread, thread_count
from camtorch.native.library import library
from camtorch.rotations import skew_matrix, small_turn

LEAST = 4  # points that make a pose
_TOLD = 6  # points that agree by chance too rarely to be looked for in vain
_FIRST, _NEXT = 512, 1024  # samples of the rounds
_SURE = 10.0  # samples without an outlier, to be expected, that end the search
_MOST = 1 << 17  # samples at most: of many points of which hardly any agree there would be no end
_TRIED, _STEPS = 8, 3  # the best poses of a round, and how often each is fitted to the points near it
_AT_ONCE = 1 << 19  # numbers of a tensor
_SHARED = 1 << 16  # points of samples that threads are woken for
_Agreement = struct.Struct("12qdq").pack  # `Agreement` of native/consensus.h

# The squared sides (0, 1), (1, 2) and (2, 0) of a triangle with corners s_i along rays r_i are, with e = |r_i - r_j|^2,
# (s_i - s_j)^2 + e s_i s_j: quadratic forms of p = s_0 - s_2, q = s_1 - s_2 and w = s_2. Of the first term; and of the
# second what there is of p w and q w, and of p q, beside w^2
_APART = [[[1, -1, 0], [-1, 1, 0], [0, 0, 0]], [[0, 0, 0], [0, 1, 0], [0, 0, 0]], [[1, 0, 0], [0, 0, 0], [0, 0, 0]]]
_ONE = [
    [[0, 0, 0.5], [0, 0, 0.5], [0.5, 0.5, 0]],
    [[0, 0, 0], [0, 0, 0.5], [0, 0.5, 0]],
    [[0, 0, 0.5], [0, 0, 0], [0.5, 0, 0]],
]
_BOTH = [[[0, 0.5, 0], [0.5, 0, 0], [0, 0, 0]], [[0.0] * 3] * 3, [[0.0] * 3] * 3]


class Consensus(NamedTuple):
    """Of B rows: rotations (B, 3, 3), translations (B, 3), and the sum of squares (B,), cut at the threshold's."""

    rotations: Tensor
    translations: Tensor
    cost: Tensor


class _Lines(NamedTuple):
    """Points and the rays that shall see them, of B rows, as far as distances in px go.

    A pose sees a point away from its ray by about the ray's slope times the point, over the point's depth on the ray:
    exact where the distance is zero, and right to some parts of a hundred within a few px.
    """

    points: Tensor  # (B, N, 3)
    measures: Tensor  # (B, 3, N, 3): the slopes of u and v by the ray, px, and the ray; zeros for what is unseen
    threshold: float

    def of(self, rows: Tensor | slice) -> _Lines:
        """Some rows."""
        return _Lines(self.points[rows], self.measures[rows], self.threshold)

    def forms(self) -> Tensor:
        """(B, 12, 3 N): what makes of [R t] the measures of all points."""
        points = pad(self.points, (0, 1), value=1.0)
        return (self.measures[..., :, None] * points[:, None, :, None]).flatten(3).flatten(1, 2).mT

    def squares(self, poses: Tensor, forms: Tensor) -> Tensor:
        """(B, S, N) px^2 at poses (B, S, 3, 4), at most the threshold's."""
        u, v, depth = (poses.flatten(2) @ forms).unflatten(2, (3, -1)).unbind(2)
        squares = (u * u).addcmul_(v, v).div_(depth * depth)
        most = self.threshold**2
        least: Tensor = squares.masked_fill_(~((squares < most) & (depth > 0)), most)
        return least

    def fitted(self, poses: Tensor, forms: Tensor) -> Tensor:
        """The poses (B, S, 3, 4) after a step of Gauss and Newton by the points near them."""
        measured = (poses.flatten(2) @ forms).unflatten(2, (3, -1))
        depth = measured[:, :, 2]
        near = self.squares(poses, forms) < self.threshold**2
        scale = torch.where(near, 1 / depth, 0.0)
        seen = measured[:, :, :2] * scale[:, :, None]
        slopes = (self.measures[:, None, :2] - seen[..., None] * self.measures[:, None, 2:]) * scale[
            :, :, None, :, None
        ]
        turned = self.points[:, None] @ poses[..., :3].mT
        columns = torch.cat((torch.linalg.cross(turned[:, :, None].expand_as(slopes), slopes), slopes), -1).flatten(
            2, 3
        )
        normal = columns.mT @ columns
        size = normal.diagonal(dim1=-2, dim2=-1)
        normal = normal + torch.diag_embed(1e-9 * size + 1e-300)
        step = -torch.linalg.solve_ex(normal, columns.mT @ seen.flatten(2)[..., None])[0]
        turn = small_turn(step[..., :3, 0])
        return torch.cat((turn @ poses[..., :3], poses[..., 3:] + step[..., 3:, :]), -1)


def consensus(points: Tensor, rays: Tensor, slopes: Tensor, seen: Tensor, threshold: float) -> Consensus:
    """The poses, camera from object, with the least sum of squared distances of points from rays, cut at a threshold.

    Triples of points are drawn (by a generator of its own, the same for all rows, whose results so do not depend on
    each other), as many as it takes to meet one without an outlier several times, judged by how many points agree with
    the best pose so far, but not fewer than six. Each has up to four poses. All are compared, and the best fitted
    to the points near them: O. Chum, J. Matas and J. Kittler, Locally Optimized RANSAC, DAGM 2003, with the cut squares
    of P. Torr and A. Zisserman, MLESAC, CVIU 2000.

    Args:
        points: (B, N, 3), finite.
        rays: (B, N, 3), of unit length.
        slopes: (B, N, 2, 3): the pixels by the rays, across them.
        seen: (B, N) bool: the others have no part in it.
        threshold: px.
    """
    measures = torch.cat((slopes, rays[..., None, :]), -2).transpose(1, 2)
    lines = _Lines(points, torch.where(seen[:, None, :, None], measures, 0.0), threshold)
    counts, order = seen.sum(-1), (~seen).long().argsort(dim=-1, stable=True)
    batch, count = seen.shape
    best = torch.eye(3, 4, dtype=points.dtype, device=points.device).repeat(batch, 1, 1)
    costs, agree = points.new_full((batch,), count * threshold**2), torch.zeros_like(counts)
    search = _Search(lines, order, counts, best, costs, agree)
    compiled = library() if points.is_cpu else None
    generator = torch.Generator().manual_seed(0)
    drawn, (rows,) = 0, (counts >= LEAST).nonzero(as_tuple=True)
    while len(rows):
        numbers = torch.rand(_NEXT if drawn else _FIRST, 3, generator=generator, dtype=torch.float64)
        if compiled is not None:
            search.compiled_round(rows, numbers, compiled)
        else:
            search.round(rows, numbers.to(points.device))
        drawn += len(numbers)
        share, few = agree[rows].clamp(min=_TOLD).to(costs), counts[rows].clamp(min=_TOLD).to(costs)
        share = share * (share - 1) * (share - 2) / (few * (few - 1) * (few - 2))
        rows = rows[drawn * share < _SURE] if drawn < _MOST else rows[:0]
    return Consensus(best[..., :3], best[..., 3], costs)


class _Search(NamedTuple):
    """What rounds of samples read, and what they leave: the best poses (B, 3, 4), costs and points near them (B,)."""

    lines: _Lines
    order: Tensor  # (B, N), those seen first
    counts: Tensor  # (B,), how many they are
    best: Tensor
    costs: Tensor
    agree: Tensor

    def round(self, rows: Tensor, numbers: Tensor) -> None:
        """One for some rows, by numbers (H, 3) in [0, 1)."""
        samples, count = len(numbers), self.order.shape[-1]
        for part in rows.split(max(1, _AT_ONCE // (12 * samples * count))):
            lines, every = self.lines.of(part), part[:, None, None]
            three = self.order[part].gather(-1, _triples(numbers, self.counts[part]).flatten(1))
            three = three.unflatten(-1, (samples, 3))
            rays = self.lines.measures[:, 2]
            poses = poses_of_three(self.lines.points[every, three].flatten(0, 1), rays[every, three].flatten(0, 1))
            forms, poses = lines.forms(), poses.view(len(part), -1, 3, 4)
            chosen = lines.squares(poses, forms).sum(-1).topk(_TRIED, largest=False).indices
            poses = poses.take_along_dim(chosen[..., None, None], 1).nan_to_num(0.0, 0.0, 0.0)
            poses = torch.cat((poses, self.best[part, None]), 1)
            for _ in range(_STEPS):
                poses = lines.fitted(poses, forms)
            squares = lines.squares(poses, forms)
            cost, index = squares.sum(-1).min(-1)
            (better,) = (cost < self.costs[part]).nonzero(as_tuple=True)
            index, part = index[better], part[better]
            self.best[part], self.costs[part] = poses[better, index], cost[better]
            self.agree[part] = (squares[better, index] < lines.threshold**2).sum(-1)

    def compiled_round(self, rows: Tensor, numbers: Tensor, compiled: ctypes.CDLL) -> None:
        """The same by native/consensus.c."""
        points, measures = self.lines.points.mT.contiguous(), self.lines.measures.mT.contiguous()
        read = (points, measures, self.order, self.counts, numbers, self.best, self.costs, self.agree, rows)
        following, count = ctypes.c_int64(0), self.order.shape[-1]
        call = _Agreement(
            *(t.data_ptr() for t in read),
            *(len(rows), count, len(numbers), self.lines.threshold**2, ctypes.addressof(following)),
        )
        work = len(rows) * len(numbers) * count
        spread(lambda: compiled.camtorch_consensus(call), min(thread_count(), len(rows), 1 + work // _SHARED))


def _triples(numbers: Tensor, counts: Tensor) -> Tensor:
    """(B, H, 3) different whole numbers below counts (B,), of numbers (H, 3) in [0, 1)."""
    i, j, k = (numbers * (counts[:, None, None] - torch.arange(3, device=counts.device))).long().unbind(-1)
    j = j + (j >= i)
    low, high = torch.minimum(i, j), torch.maximum(i, j)
    k = k + (k >= low)
    return torch.stack((i, j, k + (k >= high)), -1)


def poses_of_three(points: Tensor, rays: Tensor) -> Tensor:
    """(M, 4, 3, 4): the poses [R t] in which triangles (M, 3, 3) have their corners on rays (M, 3, 3), or NaN.

    The ratios of the corners' distances are where two conics meet: on the two lines that one of their pencil falls
    into, whose place there is a root of a cubic (M. Persson and K. Nordberg, Lambda Twist, ECCV 2018; Y. Ding et al.,
    Revisiting the P3P Problem, CVPR 2023). In differences of the distances instead of the distances, nothing cancels
    where the view is narrow.
    """
    constant, one, both = points.new_tensor([_APART, _ONE, _BOTH])
    flat = torch.diag(points.new_tensor([0.0, 0.0, 1.0]))
    apart = (rays - rays.roll(-1, 1)).square().sum(-1)[..., None, None]
    sides = (points - points.roll(-1, 1)).square().sum(-1)[..., None, None]
    # w in units that make its factors those of p and q
    width, longest = apart.amax(1, keepdim=True).sqrt(), sides.amax(1, keepdim=True)
    forms = constant + apart / width**2 * (flat + width * one + width**2 * both)
    sides = sides / longest
    conics = forms[:, ::2] * sides[:, 1:2] - forms[:, 1:2] * sides[:, ::2]
    # det(C0 + x C1), by the larger of the two first
    adjugates = _adjugate(conics)
    products = adjugates.flatten(2) @ conics.flatten(2).mT
    swap = products[:, 0, 0].abs() > products[:, 1, 1].abs()
    conics = torch.where(swap[:, None, None, None], conics.flip(1), conics)
    products = torch.where(swap[:, None, None], products.flip(1, 2), products)
    root = _root(products[:, 0, 0] / 3, products[:, 0, 1], products[:, 1, 0], products[:, 1, 1] / 3)[:, None, None]
    lines = _split(conics[:, 0] + root * conics[:, 1])
    skew = skew_matrix(lines)
    other = (root * conics[:, 0] - conics[:, 1])[:, None]
    meets = _split(skew.mT @ other @ skew).flatten(1, 2)
    # of the length that the sides have, and ahead
    whole = ((meets @ forms.sum(1)) * meets).sum(-1)
    meets = meets * ((sides.sum(1)[..., 0] / whole).sqrt() * meets[..., 2].sign())[..., None]
    w = meets[..., 2:] / width[:, 0]
    distances = torch.cat((meets[..., :2] + w, w), -1) * longest[:, 0].sqrt()
    distances = torch.where((distances > 0).all(-1, keepdim=True), distances, torch.nan)
    corners = distances[..., None] * rays[:, None]
    rotations = _frame(corners) @ _frame(points)[:, None].mT
    translations = corners.mean(-2)[..., None] - rotations @ points.mean(-2)[:, None, :, None]
    return torch.cat((rotations, translations), -1)


def _adjugate(matrices: Tensor) -> Tensor:
    """Of symmetric (..., 3, 3)."""
    adjugate: Tensor = torch.linalg.cross(matrices.roll(-1, -2), matrices.roll(-2, -2))
    return adjugate


def _split(conics: Tensor) -> Tensor:
    """(..., 2, 3): the two of which symmetric matrices (..., 3, 3) of rank two are the product, or NaN.

    J. Richter-Gebert, Perspectives on Projective Geometry, 2011, section 11.1.
    """
    square = -_adjugate(conics)
    diagonal = square.diagonal(dim1=-2, dim2=-1)
    most, index = diagonal.max(-1, keepdim=True)
    meet = square.take_along_dim(index[..., None], -2)[..., 0, :] / most.sqrt()
    product = conics + skew_matrix(meet)
    place = product.abs().flatten(-2).argmax(-1)[..., None, None]
    row = product.take_along_dim(place // 3, -2)[..., 0, :]
    column = product.take_along_dim(place % 3, -1)[..., 0]
    return torch.stack((row, column), -2)


def _root(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    """A real root of a + b x + c x^2 + d x^3, the one furthest from the others where there are three."""
    a, b, c = a / d, b / d, c / (3 * d)
    q, r = c * c - b / 3, c * (c * c - b / 2) + a / 2
    excess = r * r - q * q * q
    large = (r.abs() + excess.clamp(min=0.0).sqrt()).pow(1 / 3)
    one = large + torch.where(large > 0, q / large, 0.0)
    three = 2 * q.clamp(min=0.0).sqrt()
    three = three * torch.cos(torch.acos((2 * r.abs() / (three * q)).clamp(max=1.0)) / 3)
    x = -torch.where(excess > 0, one, three) * torch.where(r < 0, -1.0, 1.0) - c
    for _ in range(2):
        x = x - (((x + 3 * c) * x + b) * x + a) / ((3 * x + 6 * c) * x + b)
    return x


def _frame(corners: Tensor) -> Tensor:
    """(..., 3, 3), columns: along a side of triangles (..., 3, 3), and across their planes."""
    first, second, third = corners.unbind(-2)
    first = torch.nn.functional.normalize(second - first, dim=-1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(first, third - second), dim=-1)
    return torch.stack((first, torch.linalg.cross(normal, first), normal), -1)
