"""Calls of the compiled library whose answers are known: it gives them before it is used."""

import math
from collections.abc import Callable, Iterable
from ctypes import Array, c_double, c_float, c_int32, c_int64, c_uint8
from ctypes import addressof as at

from camtorch.native import structs
from camtorch.native.structs import CELL_CUBIC, Library

_ROUNDING = 1e-9
Answer = tuple[Iterable[float], Iterable[float]]
"""What a call gave, and what it should have given."""


def wrong(library: Library) -> str | None:
    """Return the name of a call that gives another answer than it should, or None if all are right."""
    for name, answer in ANSWERS.items():
        given, known = answer(library, Numbers())
        if not all(abs(a - b) < _ROUNDING for a, b in zip(given, known, strict=True)):
            return name
    return None


def _numbers(*values: float) -> Array[c_double]:
    return (c_double * len(values))(*values)


class Numbers:
    """What calls read, most of it of a pinhole camera, and memory that they write to."""

    def __init__(self) -> None:
        self.parts, self.intrinsics = (structs.Part * 2)(), _numbers(2, 2, 1, 1)
        self.camera = structs.Cameras(parts=at(self.parts), part_count=1, is_double=1, cameras=1)
        self.camera.intrinsics = at(self.intrinsics)
        self.points = _numbers(1, 2, 4, -3, 1, 4, 2, -2, 4, 1, -1, 2)
        self.pixels = _numbers(1.5, 2, -0.5, 1.5, 2, 0, 2, 0)
        self.ones, self.zeros, self.twos = (_numbers(*[i] * 8) for i in (1, 0, 2))
        self.unit, self.quarter = _numbers(1, 0, 0, 0, 1, 0, 0, 0, 1), _numbers(0, -1, 0, 1, 0, 0, 0, 0, 1)
        self.made, self.valid, self.counters = (c_double * 272)(), (c_uint8 * 128)(*[1] * 128), (c_int64 * 4)()
        self.out, self.next, self.left = at(self.made), at(self.counters), at(self.counters) + 8
        self.nodes, self.scratch = (c_float * 144)(), (c_float * (9 * structs.SCRATCH))()
        self.cell, self.exact = c_int32(), (c_double * (2 * structs.SQUARES))()
        self.image, self.samples = (c_float * 4)(0, 1, 2, 3), (c_float * 2)()


def _geometry(library: Library, n: Numbers) -> Answer:
    rows = structs.Rows(cameras=at(n.camera), rows=at(n.points), results=n.out, valid=at(n.valid), count=4, tile=4)
    rows.row_strides[:], rows.result_strides[:] = (0, 3, 1), (0, 2, 1)
    library.camtorch_geometry(rows)
    return n.made[:8], n.pixels


def _moves(library: Library, n: Numbers) -> Answer:
    move = structs.Move(to=at(n.camera), cameras=1, form=structs.PIXELS, height=8, width=8, count=4, tile=4)
    move.from_, move.rows, move.results, move.valid = at(n.camera), at(n.pixels), n.out, at(n.valid)
    move.row_strides[:] = move.result_strides[:] = 0, 2, 1
    library.camtorch_moves(move)
    return n.made[:8], n.pixels


def _job(n: Numbers) -> structs.Job:
    """Return a job for two channels of an image of two pixels, sampled in its middle."""
    job = structs.Job(type=structs.FLOAT32, mode=structs.BILINEAR, count=1, channels=2, height=1, width=1, tile_rows=8)
    job.source, job.result, job.source_height, job.source_width = at(n.image), at(n.samples), 1, 2
    job.source_strides[:], job.result_strides[:] = (4, 2, 2, 1), (2, 1, 1, 1)
    job.grid, job.grid_is_double, job.fill, job.fill_elements = at(n.zeros), 1, at(n.image), at(n.image)
    return job


def _sample(library: Library, n: Numbers) -> Answer:
    library.camtorch_sample(_job(n))
    return n.samples, (0.5, 2.5)


def _sample_images(library: Library, n: Numbers) -> Answer:
    job = _job(n)
    library.camtorch_sample_images(structs.Images(jobs=at(job), count=1))
    return n.samples, (0.5, 2.5)


def _asked(n: Numbers) -> structs.Classification:
    """Return the question of what kind a lattice's only cell is."""
    asked = structs.Classification(nodes=at(n.nodes), count=1, rows=1, columns=1, height=8, width=8, tolerance=0.1)
    asked.node_strides[:], asked.mapped, asked.rim, asked.cells = (72, 36), at(n.valid), at(n.valid), at(n.cell)
    asked.source_height, asked.source_width, asked.scratch = 8, 8, at(n.scratch)
    return asked


def _classify(library: Library, n: Numbers) -> Answer:
    most = library.camtorch_classify(_asked(n))
    return (n.cell.value, most), (CELL_CUBIC, 0)


def _lay(library: Library, n: Numbers) -> Answer:
    grid, n.cell.value, n.nodes[50] = (c_float * 128)(), CELL_CUBIC, 64  # v at the cell's first corner
    laying = structs.Laying(nodes=at(n.nodes), cells=at(n.cell), grid=at(grid), mapped=at(n.valid), height=8, width=8)
    laying.count = laying.rows = laying.columns = 1
    library.camtorch_lay(laying)
    return grid[:4], (0, 64, 0, 59.0625)


def _lattice_of(n: Numbers) -> structs.Lattices:
    """Return a lattice of one cell whose nodes are all at the same place."""
    made = structs.Lattices(cells=_asked(n), exact=at(n.exact), narrow=at(n.nodes), used=n.left)
    move, asked = made.move, made.cells
    move.from_ = move.to = at(n.camera)
    move.cameras, move.form, move.height, move.width, move.count, move.tile = 1, structs.POSITIONS, 8, 8, 68, 68
    move.rows, move.results, move.valid = at(n.pixels), n.out, at(n.valid)
    move.row_strides[:], move.result_strides[:] = (0, 0, 1), (0, 1, 68)
    asked.nodes, asked.node_strides[:] = n.out, (136, 68)
    return made


def _lattices(library: Library, n: Numbers) -> Answer:
    most = library.camtorch_lattices(_lattice_of(n))
    return (most, n.cell.value, n.nodes[0], n.nodes[71]), (0, CELL_CUBIC, -0.5, -0.375)


def _domain(library: Library, n: Numbers) -> Answer:
    n.parts[1].kind, n.parts[1].factor, n.parts[1].n = structs.PLANAR, structs.POLYNOMIAL, 1
    bend, ends = _numbers(-1 / 12), _numbers(100)  # r - r^3 / 12 has its fold at 2
    domain = structs.Domain(parts=at(n.parts), part_count=2, is_double=1, cameras=1, is_radial=1, most=1e77)
    domain.parameters, domain.parameter_count, domain.ends, domain.usual_ends = at(bend), 1, at(ends), at(ends)
    domain.safe_radius_sq, domain.image_radius_sq = n.out, n.out + 8
    library.camtorch_domain(domain)
    return n.made[:2], (4, 4)


def _draws(library: Library, n: Numbers) -> Answer:
    start = structs.Start(height=8, width=8, sized=at(n.intrinsics), base=at(n.camera))
    drawn = structs.Drawn(zoom=100, focal=1, crop=1)
    draws = structs.Draws(start=at(start), drawn=at(drawn), cameras=1, room=n.out, factors=n.out, filled=n.out)
    most = library.camtorch_draws(draws)
    return (most, *n.made[:4]), (0, 200, 200, 1, 1)


def _turns(library: Library, n: Numbers) -> Answer:
    turned, quarter = _numbers(*n.unit), _numbers(0, 0, 2)
    library.camtorch_turns(at(quarter), 3, at(turned), 1)
    return turned, n.quarter


def _together(library: Library, n: Numbers) -> Answer:
    both, results = (structs.Turned * 2)(), _numbers(*[0] * 6)
    for i, (form, rows) in enumerate(((structs.RAYS, n.points), (structs.ROTATION_VECTORS, n.zeros))):
        one = both[i]
        one.turn, one.rows, one.results, one.count = at(n.quarter), at(rows), at(results) + 24 * i, 1
        one.is_double, one.form, one.strides[:] = 1, form, (3, 1)
    together = structs.Together(turned=at(both), turned_count=2, lattices=_lattice_of(n))
    most = library.camtorch_together(together)
    return (most, *results), (0, -2, 1, 4, 0, 0, math.pi / 2)


def _views(library: Library, n: Numbers) -> Answer:
    views = structs.Views(cameras=at(n.camera), points=at(n.points), rotations=at(n.unit), problems=1)
    views.translations, views.pixels, views.given, views.views, views.count = at(n.zeros), at(n.twos), at(n.ones), 1, 4
    views.residuals, views.weights, views.valid, views.costs = n.out, n.out + 64, at(n.valid), n.out + 128
    views.left = n.left
    library.camtorch_views(views)
    return n.made[:8], [pixel - 2 for pixel in n.pixels]


def _steps(library: Library, n: Numbers) -> Answer:
    system = _numbers(4, 2)
    solve = structs.Steps(view=at(system), shared=at(n.zeros), damping=at(n.zeros), problems=1, views=1, width=1)
    solve.of_views, solve.of_shared, solve.rest, solve.left = n.out, n.out + 8, n.out + 16, n.left
    library.camtorch_steps(solve)
    return (n.made[0], n.made[2]), (-0.5, 0)


def _poses(library: Library, n: Numbers) -> Answer:
    poses = structs.Poses(cameras=at(n.camera), points=at(n.points), pixels=at(n.pixels), weights=at(n.ones))
    poses.point_rows = poses.row_count = poses.steps = poses.damping = 1
    poses.count, poses.task = 4, structs.REFINED
    poses.rotations, poses.translations, poses.valid, poses.costs = at(n.unit), at(n.zeros), at(n.valid), n.out
    poses.next, poses.left = n.next, n.left
    library.camtorch_poses(poses)
    return (n.made[0], *n.unit), (0, 1, 0, 0, 0, 1, 0, 0, 0, 1)


def _consensus(library: Library, n: Numbers) -> Answer:
    corners = [n.points[i : i + 3] for i in range(0, 12, 3)]
    lines = [[(z, 0, -x), (0, z, -y), (x, y, z)] for x, y, z in corners]  # slopes of u and v by the ray, and that
    measures = _numbers(*(row[i][k] / math.hypot(*row[2]) for i in range(3) for k in range(3) for row in lines))
    planes, order = _numbers(*(point[k] for k in range(3) for point in corners)), (c_int64 * 5)(0, 1, 2, 3, 4)
    found = structs.Agreement(points=at(planes), measures=at(measures), order=at(order), counts=at(order) + 32, count=4)
    found.numbers, found.best, found.costs, found.agree = at(n.zeros), n.out, n.out + 96, n.left + 8
    found.rows, found.row_count, found.samples, found.most, found.next, n.made[12] = at(order), 1, 1, 1, n.next, 4
    library.camtorch_consensus(found)
    return (*n.made[:13], n.counters[2]), (1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 4)


_ANSWERED = (
    *(_geometry, _moves, _sample, _sample_images, _classify, _lay, _lattices, _domain, _draws, _turns, _together),
    *(_views, _steps, _poses, _consensus),
)
ANSWERS: dict[str, Callable[[Library, Numbers], Answer]] = {f"camtorch{each.__name__}": each for each in _ANSWERED}
