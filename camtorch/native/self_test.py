"""Calls of the compiled library whose answers are known: it gives them before it is used."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from ctypes import Array, c_double, c_float, c_int32, c_int64, c_uint8
from ctypes import addressof as at

from camtorch.native import structs
from camtorch.native.structs import CELL_CUBIC, Library

_NEAR = 1e-9


def wrong(library: Library) -> str | None:
    """Return the name of a call that gives another answer than it should, or None if all are right."""
    for name, given, known in _answers(library):
        if not all(abs(a - b) < _NEAR for a, b in zip(given, known, strict=True)):
            return name
    return None


def _numbers(*values: float) -> Array[c_double]:
    return (c_double * len(values))(*values)


def _answers(library: Library) -> Iterator[tuple[str, Iterable[float], Iterable[float]]]:
    """Yield the name of each call, what it gave and what it should have given. Most are of a pinhole camera."""
    parts, intrinsics = (structs.Part * 2)(), _numbers(2, 2, 1, 1)
    camera = structs.Cameras(parts=at(parts), part_count=1, is_double=1, cameras=1, intrinsics=at(intrinsics))
    points, pixels = _numbers(1, 2, 4, -3, 1, 4, 2, -2, 4, 1, -1, 2), _numbers(1.5, 2, -0.5, 1.5, 2, 0, 2, 0)
    ones, zeros, twos = (_numbers(*[i] * 8) for i in (1, 0, 2))
    unit = _numbers(1, 0, 0, 0, 1, 0, 0, 0, 1)
    made, valid, counters = (c_double * 272)(), (c_uint8 * 128)(*[1] * 128), (c_int64 * 4)()
    out, next_, left = at(made), at(counters), at(counters) + 8
    rows = structs.Rows(cameras=at(camera), rows=at(points), results=out, valid=at(valid), count=4, tile=4)
    rows.row_strides[:], rows.result_strides[:] = (0, 3, 1), (0, 2, 1)
    library.camtorch_geometry(rows)
    yield "camtorch_geometry", made[:8], pixels

    move = structs.Move(to=at(camera), cameras=1, form=structs.PIXELS, height=8, width=8, count=4, tile=4)
    move.from_, move.rows, move.results, move.valid = at(camera), at(pixels), out, at(valid)
    move.row_strides[:] = move.result_strides[:] = 0, 2, 1
    library.camtorch_moves(move)
    yield "camtorch_moves", made[:8], pixels

    image, results = (c_float * 4)(0, 1, 2, 3), (c_float * 2)()
    job = structs.Job(type=structs.FLOAT32, mode=structs.BILINEAR, count=1, channels=2, height=1, width=1, tile_rows=8)
    job.source, job.result, job.source_height, job.source_width = at(image), at(results), 1, 2
    job.source_strides[:], job.result_strides[:] = (4, 2, 2, 1), (2, 1, 1, 1)
    job.grid, job.grid_is_double, job.fill, job.fill_elements = out + 8 * 64, 1, at(image), at(image)
    library.camtorch_sample(job)
    yield "camtorch_sample", results, (0.5, 2.5)

    images, results[:] = structs.Images(jobs=at(job), count=1), [0, 0]
    library.camtorch_sample_images(images)
    yield "camtorch_sample_images", results, (0.5, 2.5)

    nodes, scratch, cells = (c_float * 144)(), (c_float * (9 * structs.SCRATCH))(), c_int32()
    asked = structs.Classification(nodes=at(nodes), count=1, rows=1, columns=1, height=8, width=8, tolerance=0.1)
    asked.node_strides[:], asked.mapped, asked.rim, asked.cells = (72, 36), at(valid), at(valid), at(cells)
    asked.source_height, asked.source_width, asked.scratch = 8, 8, at(scratch)
    most = library.camtorch_classify(asked)
    yield "camtorch_classify", (cells.value, most), (CELL_CUBIC, 0)

    grid, nodes[50] = (c_float * 128)(), 64  # v at the cell's first corner
    laying = structs.Laying(nodes=at(nodes), cells=at(cells), grid=at(grid), mapped=at(valid), height=8, width=8)
    laying.count = laying.rows = laying.columns = 1
    library.camtorch_lay(laying)
    yield "camtorch_lay", grid[:4], (0, 64, 0, 59.0625)

    exact = (c_double * (2 * structs.SQUARES))()
    lattices = structs.Lattices(move=move, cells=asked, exact=at(exact), narrow=at(nodes), used=left)
    move, asked, cells.value = lattices.move, lattices.cells, 0
    move.form, move.count, move.tile = structs.POSITIONS, 68, 68
    move.row_strides[:], move.result_strides[:] = (0, 0, 1), (0, 1, 68)
    asked.nodes, asked.node_strides[:] = out, (136, 68)
    most = library.camtorch_lattices(lattices)
    yield "camtorch_lattices", (most, cells.value, nodes[0], nodes[71]), (0, CELL_CUBIC, -0.5, -0.375)

    parts[1].kind, parts[1].factor, parts[1].n = structs.PLANAR, structs.POLYNOMIAL, 1
    bend, ends = _numbers(-1 / 12), _numbers(100)  # r - r^3 / 12 has its fold at 2
    domain = structs.Domain(parts=at(parts), part_count=2, is_double=1, cameras=1, is_radial=1, most=1e77)
    domain.parameters, domain.parameter_count, domain.ends, domain.usual_ends = at(bend), 1, at(ends), at(ends)
    domain.safe_radius_sq, domain.image_radius_sq = out, out + 8
    library.camtorch_domain(domain)
    yield "camtorch_domain", made[:2], (4, 4)

    draws = structs.Draws(cameras=1, height=8, width=8, sized=at(intrinsics), base=at(camera), made=camera, room=out)
    draws.first[:], draws.factors, draws.filled = [-1] * structs.DRAWN_KINDS, out, out
    draws.first[structs.ZOOM], draws.values = 0, at(ends)
    most = library.camtorch_draws(draws)
    yield "camtorch_draws", (most, *made[:4]), (0, 200, 200, 1, 1)

    turned, quarter = _numbers(*unit), _numbers(0, 0, 2)
    library.camtorch_turns(at(quarter), 3, at(turned), 1)
    yield "camtorch_turns", turned, (0, -1, 0, 1, 0, 0, 0, 0, 1)

    both = (structs.Turned * 2)()
    for one, form, given in zip(both, (structs.RAYS, structs.ROTATION_VECTORS), (points, zeros), strict=True):
        one.turn, one.rows, one.results, one.count, one.is_double, one.form = at(turned), at(given), out, 1, 1, form
        one.strides[:], out = (3, 1), out + 24
    together = structs.Together(turned=at(both), turned_count=2, lattices=lattices)
    most, out = library.camtorch_together(together), at(made)
    yield "camtorch_together", (most, *made[:6]), (0, -2, 1, 4, 0, 0, math.pi / 2)

    views = structs.Views(cameras=at(camera), points=at(points), rotations=at(unit), translations=at(zeros), problems=1)
    views.pixels, views.given, views.views, views.count, views.left = at(twos), at(ones), 1, 4, left
    views.residuals, views.weights, views.valid, views.costs = out, out + 64, at(valid), out + 128
    library.camtorch_views(views)
    yield "camtorch_views", made[:8], [pixel - 2 for pixel in pixels]

    system = _numbers(4, 2)
    solve = structs.Steps(view=at(system), shared=at(zeros), damping=at(zeros), problems=1, views=1, width=1)
    solve.of_views, solve.of_shared, solve.rest, solve.left = out, out + 8, out + 16, left
    library.camtorch_steps(solve)
    yield "camtorch_steps", (made[0], made[2]), (-0.5, 0)

    poses = structs.Poses(cameras=at(camera), points=at(points), pixels=at(pixels), weights=at(ones), point_rows=1)
    poses.row_count, poses.count, poses.task, poses.steps, poses.damping = 1, 4, structs.REFINED, 1, 1
    poses.rotations, poses.translations, poses.valid, poses.costs = at(unit), at(zeros), at(valid), out
    poses.next, poses.left = next_, left
    library.camtorch_poses(poses)
    yield "camtorch_poses", (made[0], *unit), (0, 1, 0, 0, 0, 1, 0, 0, 0, 1)

    corners = [points[i : i + 3] for i in range(0, 12, 3)]
    lines = [[(z, 0, -x), (0, z, -y), (x, y, z)] for x, y, z in corners]  # slopes of u and v by the ray, and that
    measures = _numbers(*(row[i][k] / math.hypot(*row[2]) for i in range(3) for k in range(3) for row in lines))
    planes, order = _numbers(*(point[k] for k in range(3) for point in corners)), (c_int64 * 5)(0, 1, 2, 3, 4)
    found = structs.Agreement(points=at(planes), measures=at(measures), order=at(order), counts=at(order) + 32, count=4)
    found.numbers, found.best, found.costs, found.agree, found.rows = at(zeros), out, out + 96, left + 8, at(order)
    found.row_count, found.samples, found.most, found.next, made[12], counters[0] = 1, 1, 1, next_, 4, 0
    library.camtorch_consensus(found)
    yield "camtorch_consensus", (*made[:13], counters[2]), (1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 4)
