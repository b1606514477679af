"""The pose on which most seen points agree, by random samples: RANSAC on rays of any angle."""

from ctypes import addressof, c_int64
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from camtorch.calibration.rays import poses_from_rays
from camtorch.native.library import library
from camtorch.native.structs import Agreement
from camtorch.poses.rotations import small_turn
from camtorch.values.threads import spread, thread_count

LEAST = 4  # points that determine a pose
_CONVINCING = 6  # points: fewer may agree by chance
_FIRST, _NEXT = 512, 1024  # samples in the first round and in each further one
_SURE = 10.0  # the expected number of samples without an outlier at which the search ends
# the most samples, for points of which hardly any agree: of three points, and of four without native code
_MOST_SAMPLES, _MOST_SAMPLES_OF_FOUR = 1 << 17, 1 << 14
_TRIED, _STEPS = 8, 3  # the best poses of a round, and the fits of each to the points near it
_AT_ONCE = 1 << 19  # numbers of a tensor, at most
_SHARED = 1 << 16  # points of samples for each further thread


class _Lines(NamedTuple):
    """B rows of points and their rays.

    A posed point is about (the ray's slopes times the point) / (the point's depth along the ray) px from its pixel.
    """

    points: Tensor  # (B, N, 3)
    measures: Tensor  # (B, 3, N, 3): the slopes of u and v by the ray, px, and the ray; zeros if unseen
    threshold: float

    def squares(self, poses: Tensor, forms: Tensor) -> Tensor:
        """Return squared distances (B, S, N) in px^2 at poses (B, S, 3, 4), at most the threshold's square."""
        u, v, depth = (poses.flatten(2) @ forms).unflatten(2, (3, -1)).unbind(2)
        squares = (u * u).addcmul_(v, v).div_(depth * depth)
        most = self.threshold**2
        least: Tensor = squares.masked_fill_(~((squares < most) & (depth > 0)), most)
        return least

    def fitted(self, poses: Tensor, forms: Tensor) -> Tensor:
        """Return the poses (B, S, 3, 4) after a Gauss-Newton step by the points near them."""
        measured = (poses.flatten(2) @ forms).unflatten(2, (3, -1))
        depth = measured[:, :, 2]
        near = self.squares(poses, forms) < self.threshold**2
        scale = torch.where(near, 1 / depth, 0.0)
        seen = measured[:, :, :2] * scale[:, :, None]
        slopes = self.measures[:, None, :2] - seen[..., None] * self.measures[:, None, 2:]
        slopes = slopes * scale[:, :, None, :, None]
        turned = self.points[:, None] @ poses[..., :3].mT
        across = torch.linalg.cross(turned[:, :, None].expand_as(slopes), slopes)
        columns = torch.cat((across, slopes), -1).flatten(2, 3)
        normal = columns.mT @ columns
        normal = normal + torch.diag_embed(1e-9 * normal.diagonal(dim1=-2, dim2=-1) + 1e-300)
        step = -torch.linalg.solve_ex(normal, columns.mT @ seen.flatten(2)[..., None])[0]
        return torch.cat((small_turn(step[..., :3, 0]) @ poses[..., :3], poses[..., 3:] + step[..., 3:, :]), -1)


def consensus(points: Tensor, rays: Tensor, slopes: Tensor, seen: Tensor, threshold: float) -> tuple[Tensor, Tensor]:
    """Return the poses, camera from object, of least squared distances of points from rays, clipped at a threshold.

    Samples of few points are drawn, by one generator for all rows, until several without an outlier are expected, by
    the points that agree with the best pose so far. Three points have up to four poses (native/consensus.c), four those
    of `poses_from_rays`. The best poses are fitted to the points near them: O. Chum, J. Matas and J. Kittler, Locally
    Optimized RANSAC, DAGM 2003; P. Torr and A. Zisserman, MLESAC, CVIU 2000.

    Points (B, N, 3) are finite, rays (B, N, 3) of unit length; slopes (B, N, 2, 3) are the derivatives of pixels by
    rays, across these; points that are not `seen`, bool (B, N), are ignored. The threshold is in px.
    """
    measures = torch.cat((slopes, rays[..., None, :]), -2).transpose(1, 2)
    lines = _Lines(points, torch.where(seen[:, None, :, None], measures, 0.0), threshold)
    counts, order = seen.sum(-1), (~seen).long().argsort(dim=-1, stable=True)
    batch, count = seen.shape
    best = torch.eye(3, 4, dtype=points.dtype, device=points.device).repeat(batch, 1, 1)
    costs, agree = points.new_full((batch,), count * threshold**2), torch.zeros_like(counts)
    compiled = library() if points.is_cpu else None
    generator = torch.Generator().manual_seed(0)
    drawn, (rows,) = 0, (counts >= LEAST).nonzero(as_tuple=True)
    while len(rows):
        samples, size = _NEXT if drawn else _FIRST, 4 if compiled is None else 3
        numbers = torch.rand(samples, 3 if compiled else count, generator=generator, dtype=torch.float64)
        if compiled is not None:
            call, following = Agreement(), c_int64(0)
            call.points = call.keep(lines.points.mT.contiguous())
            call.measures = call.keep(lines.measures.mT.contiguous())
            call.order, call.counts, call.numbers = order.data_ptr(), counts.data_ptr(), numbers.data_ptr()
            call.best, call.costs, call.agree = best.data_ptr(), costs.data_ptr(), agree.data_ptr()
            call.rows, call.row_count, call.count, call.samples = rows.data_ptr(), len(rows), count, samples
            call.most, call.next = threshold**2, addressof(following)
            threads = min(thread_count(), len(rows), 1 + len(rows) * samples * count // _SHARED)
            spread(partial(compiled.camtorch_consensus, call), threads)
        else:
            _run_round(lines, order, counts, (best, costs, agree), rows, numbers.to(points.device))
        drawn += samples
        share, few = agree[rows].clamp(min=_CONVINCING).to(costs), counts[rows].clamp(min=_CONVINCING).to(costs)
        share = torch.stack([(share - i) / (few - i) for i in range(size)]).prod(0)
        most = _MOST_SAMPLES_OF_FOUR if compiled is None else _MOST_SAMPLES
        rows = rows[drawn * share < _SURE] if drawn < most else rows[:0]
    return best[..., :3], best[..., 3]


def _run_round(
    lines: _Lines, order: Tensor, counts: Tensor, found: tuple[Tensor, Tensor, Tensor], rows: Tensor, numbers: Tensor
) -> None:
    """Improve what was found for some rows, poses (B, 3, 4), costs and numbers of near points (B,), by a round.

    The order (B, N) of points has seen ones first, whose numbers are `counts`; samples are drawn by `numbers` (H, N).
    """
    best, costs, agree = found
    samples, count = numbers.shape
    for part in rows.split(max(1, _AT_ONCE // (12 * samples * count))):
        these = _Lines(lines.points[part], lines.measures[part], lines.threshold)
        first = torch.arange(count, device=rows.device) < counts[part, None]
        is_seen = torch.zeros_like(first).scatter(1, order[part], first)
        four = torch.where(is_seen[:, None], numbers, -1.0).topk(4).indices
        given = lines.points, lines.measures[:, 2]
        points, rays = (t[part[:, None, None], four].flatten(0, 1) for t in given)
        made = poses_from_rays(points, rays, torch.ones_like(rays[..., 0]))
        poses = torch.cat((made.rotations, made.translations[..., None]), -1)
        poses = torch.where(made.valid[..., None, None], poses, torch.nan)
        # matrices (B, 12, 3 N) that map [R t] to the measures of all points
        forms = these.measures[..., :, None] * pad(these.points, (0, 1), value=1.0)[:, None, :, None]
        forms, poses = forms.flatten(3).flatten(1, 2).mT, poses.view(len(part), -1, 3, 4)
        chosen = these.squares(poses, forms).sum(-1).topk(_TRIED, largest=False).indices
        poses = poses.take_along_dim(chosen[..., None, None], 1).nan_to_num(0.0, 0.0, 0.0)
        poses = torch.cat((poses, best[part, None]), 1)
        for _ in range(_STEPS):
            poses = these.fitted(poses, forms)
        squares = these.squares(poses, forms)
        cost, index = squares.sum(-1).min(-1)
        (better,) = (cost < costs[part]).nonzero(as_tuple=True)
        index, part = index[better], part[better]
        best[part], costs[part] = poses[better, index], cost[better]
        agree[part] = (squares[better, index] < these.threshold**2).sum(-1)
