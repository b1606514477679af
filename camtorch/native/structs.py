"""The structures, numbers and calls of the C files: `python -m camtorch.native.headers` writes them."""

from collections.abc import Callable
from ctypes import c_double, c_int32, c_int64, c_void_p
from typing import Annotated

from camtorch.native.structure import Double, Int32, Int64, Numbers, Pointer, Struct, Text, TypedLibrary, Unsigned, Void

CHECKSUM = 245809308

CELL_MISSED = 0.0703125
CELL_MARGIN = 0.05
CELL_OVERSHOOT = 0.5
CELL_OFF = 4.0
SMOOTH = 0.02
BULGE = 0.001
FAR_IMAGE = 20.0
BEYOND = 1.01
OUTSIDE = -9.0
FAR = 100.0
NEARLY_ROTATION = 0.001
JITTER_PARTS = (1.0, -1.0, 0.5, -0.5, 0.25, -0.25, 0.125, -0.125)
TO_FOLD = 0.98
NEARLY_FILLED = 0.999
MOST_ZOOM = 4.0
FAR_ZOOM = 1000.0
TURN_PARTS = (1.0, 0.5, 0.25, 0.0)
LOST = 1000.0
UINT8, BOOL, UINT16, FLOAT32, BYTES1, BYTES2, BYTES4, BYTES8, TYPES = range(9)
NEAREST, BILINEAR, BICUBIC = range(3)
ZEROS, BORDER, REFLECTION = range(3)
SCRATCH = 25
STEP = 8
CELL_QUINTIC, CELL_DOUBT, CELL_NEXT, CELL_EMPTY, CELL_CUBIC, CELL_TODO = -5, -4, -3, -2, -1, 0
PERSPECTIVE, EQUIDISTANT, EQUISOLID, UNIFIED, FOV, ONE_DIVISION, INVERTED, CYLINDER, SPHERE = range(9)
HAS_XI, HAS_ALPHA, HAS_BETA, TRANSVERSE = 1, 2, 4, 8
PLANAR, HOMOGRAPHY, SHEAR, SURFACE = 16, 17, 18, 19
TANGENTIAL, PRISM = 1, 2
NO_FACTOR, POLYNOMIAL, RATIONAL, RADIUS_POLYNOMIAL, ANGLE_PER_RADIUS, ANGLE_OF_ALL_POWERS, RADIUS_TABLE = range(7)
MOST_PARTS = 5
MOST_DEGREE = 64
NODES = 1024
MOST_RADII = 512
AZIMUTHS = 336
RADII = 80
DIP = 65
ASIDE = 4
SPAN = 12
EXTENT = 27296
PROJECT, UNPROJECT, PROJECT_VJP, UNPROJECT_VJP = range(4)
POSITIONS, PIXELS, ON_IMAGE, BOXES = range(4)
EDGE_POINTS = 64
LEFT_FROM, LEFT_TO, LEFT_MOST, LEFT_LABELS = 1, 2, 4, 8
SQUARES = 64
LEFT_BITS = 4
RAYS, POSE, ROTATION_VECTORS = range(3)
AMOUNTS = 16
TRIES = 8
RIM = 128
LEFT_BASE, LEFT_SOURCE, LEFT_ENDS, TOO_WIDE, NO_CAMERA = 1, 2, 4, 8, 16
SPREAD, LOOKED_AT = 1000, 1064
HALVINGS = 10
FROM_RAYS, REFINED, SOLVED, AGREED = range(4)
LEAST_SQUARES, HUBER, CAUCHY = range(3)


class Agreement(Struct):
    __slots__ = ()
    points: Pointer
    measures: Pointer
    order: Pointer
    counts: Pointer
    numbers: Pointer
    best: Pointer
    costs: Pointer
    agree: Pointer
    rows: Pointer
    row_count: Int64
    count: Int64
    samples: Int64
    most: Double
    next: Pointer


class Job(Struct):
    __slots__ = ()
    source: Pointer
    result: Pointer
    source_strides: Annotated[Numbers, c_int64 * 4]
    result_strides: Annotated[Numbers, c_int64 * 4]
    count: Int64
    channels: Int64
    source_height: Int64
    source_width: Int64
    height: Int64
    width: Int64
    fill: Pointer
    fill_elements: Pointer
    grid: Pointer
    grid_strides: Annotated[Numbers, c_int64 * 4]
    grid_is_double: Int64
    mapped: Pointer
    mapped_stride: Int64
    nodes: Pointer
    node_strides: Annotated[Numbers, c_int64 * 2]
    cells: Pointer
    cell_stride: Int64
    rows: Int64
    columns: Int64
    exact: Pointer
    exact_stride: Int64
    type: Int32
    mode: Int32
    padding: Int32
    tile_rows: Int32
    next: Int64


class Images(Struct):
    __slots__ = ()
    jobs: Pointer
    count: Int64
    image: Int64


class Classification(Struct):
    __slots__ = ()
    nodes: Pointer
    node_strides: Annotated[Numbers, c_int64 * 2]
    mapped: Pointer
    mapped_stride: Int64
    rim: Pointer
    rim_stride: Int64
    count: Int64
    rows: Int64
    columns: Int64
    height: Int64
    width: Int64
    source_height: Double
    source_width: Double
    tolerance: Double
    padding: Int32
    cells: Pointer
    scratch: Pointer


class Laying(Struct):
    __slots__ = ()
    nodes: Pointer
    cells: Pointer
    exact: Pointer
    exact_count: Int64
    grid: Pointer
    mapped: Pointer
    count: Int64
    rows: Int64
    columns: Int64
    height: Int64
    width: Int64
    is_transposed: Int64
    next: Int64


class Part(Struct):
    __slots__ = ()
    kind: Int32
    flags: Int32
    factor: Int32
    n: Int32
    m: Int32
    constant: Double
    cells: Annotated[Numbers, c_double * 2]
    centre: Annotated[Numbers, c_double * 2]


class Cameras(Struct):
    __slots__ = ()
    parts: Pointer
    part_count: Int64
    is_double: Int64
    cameras: Int64
    intrinsics: Pointer
    parameters: Pointer
    parameter_count: Int64
    constants: Pointer
    constant_count: Int64
    usable: Pointer
    safe_radius_sq: Pointer
    image_radius_sq: Pointer
    limits2: Pointer
    extent: Pointer
    table: Pointer
    stagewise: Pointer
    image_circle_sq: Pointer
    chart_safe_radius_sq: Pointer
    chart_most2: Pointer
    chart_table: Pointer


class Domain(Struct):
    __slots__ = ()
    parts: Pointer
    part_count: Int64
    is_double: Int64
    cameras: Int64
    parameters: Pointer
    parameter_count: Int64
    constants: Pointer
    constant_count: Int64
    is_chart: Int64
    is_radial: Int64
    ends: Pointer
    usual_ends: Pointer
    folds: Pointer
    most: Double
    radii: Pointer
    coarse: Pointer
    even: Pointer
    safe_radius_sq: Pointer
    image_radius_sq: Pointer
    image_circle_sq: Pointer
    table: Pointer
    limits2: Pointer
    extent: Pointer
    stagewise: Pointer


class Rows(Struct):
    __slots__ = ()
    cameras: Pointer
    rows: Pointer
    row_strides: Annotated[Numbers, c_int64 * 3]
    results: Pointer
    result_strides: Annotated[Numbers, c_int64 * 3]
    valid: Pointer
    solution: Pointer
    cotangents: Pointer
    cotangent_strides: Annotated[Numbers, c_int64 * 3]
    sums: Pointer
    count: Int64
    tile: Int64
    direction: Int64
    next: Pointer


class Move(Struct):
    __slots__ = ()
    from_: Pointer
    to: Pointer
    turns: Pointer
    turn_strides: Annotated[Numbers, c_int64 * 3]
    cameras: Int64
    form: Int64
    height: Double
    width: Double
    rows: Pointer
    row_strides: Annotated[Numbers, c_int64 * 3]
    results: Pointer
    result_strides: Annotated[Numbers, c_int64 * 3]
    valid: Pointer
    count: Int64
    tile: Int64
    next: Pointer


class Lattices(Struct):
    __slots__ = ()
    move: Move
    cells: Classification
    first_row: Int64
    learns: Int64
    narrow: Pointer
    exact: Pointer
    used: Pointer
    jobs: Pointer
    job_count: Int64


class Turned(Struct):
    __slots__ = ()
    turn: Pointer
    rows: Pointer
    results: Pointer
    strides: Annotated[Numbers, c_int64 * 2]
    count: Int64
    is_double: Int64
    form: Int64


class Together(Struct):
    __slots__ = ()
    jobs: Pointer
    job_count: Int64
    is_whole: Int64
    moves: Pointer
    move_count: Int64
    turned: Pointer
    turned_count: Int64
    lattices: Lattices


class Drawn(Struct):
    __slots__ = ()
    yaw: Double
    pitch: Double
    roll: Double
    zoom: Double
    fov: Double
    focal: Double
    centre: Annotated[Numbers, c_double * 2]
    distortion: Annotated[Numbers, c_double * 16]
    crop: Double
    place: Annotated[Numbers, c_double * 2]


class Start(Struct):
    __slots__ = ()
    height: Double
    width: Double
    count: Int64
    is_each: Int64
    sized: Pointer
    reach: Pointer
    coefficients: Pointer
    sensitivity: Pointer
    ends: Pointer
    base: Pointer
    places: Pointer
    border: Pointer
    domain: Domain
    share: Double
    source: Pointer
    source_height: Double
    source_width: Double
    looked_at: Pointer


class Draws(Struct):
    __slots__ = ()
    start: Pointer
    drawn: Pointer
    cameras: Int64
    room: Pointer
    limits: Pointer
    factors: Pointer
    filled: Pointer
    made: Cameras
    rotations: Pointer
    distortion: Pointer
    followed: Int64


class Poses(Struct):
    __slots__ = ()
    cameras: Pointer
    points: Pointer
    rays: Pointer
    pixels: Pointer
    weights: Pointer
    point_rows: Int64
    row_count: Int64
    count: Int64
    task: Int64
    loss: Int64
    steps: Int64
    loss_scale: Double
    settled: Double
    nothing: Double
    damping: Double
    threshold: Double
    rotations: Pointer
    translations: Pointer
    valid: Pointer
    costs: Pointer
    vectors: Pointer
    rms: Pointer
    inliers: Pointer
    covariance: Pointer
    next: Pointer
    left: Pointer


class Views(Struct):
    __slots__ = ()
    cameras: Pointer
    points: Pointer
    point_strides: Annotated[Numbers, c_int64 * 2]
    rotations: Pointer
    translations: Pointer
    pixels: Pointer
    given: Pointer
    residuals: Pointer
    weights: Pointer
    valid: Pointer
    costs: Pointer
    problems: Int64
    views: Int64
    count: Int64
    loss: Int64
    loss_scale: Double
    learnt: Pointer
    columns: Int64
    view: Pointer
    shared: Pointer
    left: Pointer


class Steps(Struct):
    __slots__ = ()
    view: Pointer
    shared: Pointer
    damping: Pointer
    problems: Int64
    views: Int64
    width: Int64
    columns: Int64
    of_views: Pointer
    of_shared: Pointer
    rest: Pointer
    left: Pointer


STRUCTS = Agreement, Job, Images, Classification, Laying, Part, Cameras, Domain, Rows, Move, Lattices, Turned, Together, Drawn, Start, Draws, Poses, Views, Steps
for struct in STRUCTS:
    struct.lay_out()


class Library(TypedLibrary):
    """The compiled library."""

    camtorch_sample: Callable[[Job], Int32]
    camtorch_sample_images: Callable[[Images], Void]
    camtorch_classify: Callable[[Classification], Int32]
    camtorch_lay: Callable[[Laying], Void]
    camtorch_geometry: Callable[[Rows], Int64]
    camtorch_moves: Callable[[Move], Int64]
    camtorch_lattices: Callable[[Lattices], Int64]
    camtorch_domain: Callable[[Domain], Void]
    camtorch_draws: Callable[[Draws], Int64]
    camtorch_consensus: Callable[[Agreement], Void]
    camtorch_poses: Callable[[Poses], Void]
    camtorch_views: Callable[[Views], Void]
    camtorch_steps: Callable[[Steps], Void]
    camtorch_use: Callable[[Text], Int32]
    camtorch_sources: Callable[[], Unsigned]
    camtorch_layout: Callable[[], Unsigned]
    camtorch_variant: Callable[[], Text]
    camtorch_turns: Callable[[Pointer, Int64, Pointer, Int64], Void]
    camtorch_together: Callable[[Together], Int64]
