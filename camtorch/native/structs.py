"""The structures, numbers and calls of the C files: `python -m camtorch.native.headers` writes them."""

from __future__ import annotations

from collections.abc import Callable
from ctypes import POINTER, c_char_p, c_double, c_int32, c_int64, c_uint32, c_void_p

from camtorch.native.structure import Calls, Numbers, Struct

CHECKSUM = 595640963

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
UINT8 = 0
BOOL = 1
UINT16 = 2
FLOAT32 = 3
BYTES1 = 4
BYTES2 = 5
BYTES4 = 6
BYTES8 = 7
TYPES = 8
NEAREST = 0
BILINEAR = 1
BICUBIC = 2
ZEROS = 0
BORDER = 1
REFLECTION = 2
SCRATCH = 25
STEP = 8
CELL_QUINTIC = -5
CELL_DOUBT = -4
CELL_NEXT = -3
CELL_EMPTY = -2
CELL_CUBIC = -1
CELL_TODO = 0
PERSPECTIVE = 0
EQUIDISTANT = 1
EQUISOLID = 2
UNIFIED = 3
FOV = 4
ONE_DIVISION = 5
INVERTED = 6
CYLINDER = 7
SPHERE = 8
HAS_XI = 1
HAS_ALPHA = 2
HAS_BETA = 4
TRANSVERSE = 8
PLANAR = 16
HOMOGRAPHY = 17
SHEAR = 18
SURFACE = 19
TANGENTIAL = 1
PRISM = 2
NO_FACTOR = 0
POLYNOMIAL = 1
RATIONAL = 2
RADIUS_POLYNOMIAL = 3
ANGLE_PER_RADIUS = 4
ANGLE_OF_ALL_POWERS = 5
RADIUS_TABLE = 6
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
PROJECT = 0
UNPROJECT = 1
PROJECT_VJP = 2
UNPROJECT_VJP = 3
POSITIONS = 0
PIXELS = 1
ON_IMAGE = 2
BOXES = 3
EDGE_POINTS = 64
LEFT_FROM = 1
LEFT_TO = 2
LEFT_MOST = 4
LEFT_LABELS = 4
SQUARES = 64
LEFT_BITS = 3
RAYS = 0
POSE = 1
ROTATION_VECTORS = 2
YAW = 0
PITCH = 1
ROLL = 2
ZOOM = 3
WIDTH = 4
FOCAL = 5
CENTRE = 6
DISTORTION = 7
CROP = 8
PLACE = 9
DRAWN_KINDS = 10
AMOUNTS = 16
TRIES = 8
RIM = 128
LEFT_BASE = 1
LEFT_LENS = 2
LEFT_ENDS = 4
TOO_WIDE = 8
NO_CAMERA = 16
LEFT_SOURCE = 32
SPREAD = 1000
LOOKED_AT = 1064
HALVINGS = 10
FROM_RAYS = 0
REFINED = 1
SOLVED = 2
AGREED = 3
LEAST_SQUARES = 0
HUBER = 1
CAUCHY = 2


class Agreement(Struct):
    """`Agreement` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("points", c_void_p),
        ("measures", c_void_p),
        ("order", c_void_p),
        ("counts", c_void_p),
        ("numbers", c_void_p),
        ("best", c_void_p),
        ("costs", c_void_p),
        ("agree", c_void_p),
        ("rows", c_void_p),
        ("row_count", c_int64),
        ("count", c_int64),
        ("samples", c_int64),
        ("most", c_double),
        ("next", c_void_p),
    )
    points: int | None
    measures: int | None
    order: int | None
    counts: int | None
    numbers: int | None
    best: int | None
    costs: int | None
    agree: int | None
    rows: int | None
    row_count: int
    count: int
    samples: int
    most: float
    next: int | None


class Job(Struct):
    """`Job` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("source", c_void_p),
        ("result", c_void_p),
        ("source_strides", c_int64 * 4),
        ("result_strides", c_int64 * 4),
        ("count", c_int64),
        ("channels", c_int64),
        ("source_height", c_int64),
        ("source_width", c_int64),
        ("height", c_int64),
        ("width", c_int64),
        ("fill", c_void_p),
        ("fill_elements", c_void_p),
        ("grid", c_void_p),
        ("grid_strides", c_int64 * 4),
        ("grid_is_double", c_int64),
        ("mapped", c_void_p),
        ("mapped_stride", c_int64),
        ("nodes", c_void_p),
        ("node_strides", c_int64 * 2),
        ("cells", c_void_p),
        ("cell_stride", c_int64),
        ("rows", c_int64),
        ("columns", c_int64),
        ("exact", c_void_p),
        ("exact_stride", c_int64),
        ("type", c_int32),
        ("mode", c_int32),
        ("padding", c_int32),
        ("tile_rows", c_int32),
        ("next", c_int64),
    )
    source: int | None
    result: int | None
    source_strides: Numbers
    result_strides: Numbers
    count: int
    channels: int
    source_height: int
    source_width: int
    height: int
    width: int
    fill: int | None
    fill_elements: int | None
    grid: int | None
    grid_strides: Numbers
    grid_is_double: int
    mapped: int | None
    mapped_stride: int
    nodes: int | None
    node_strides: Numbers
    cells: int | None
    cell_stride: int
    rows: int
    columns: int
    exact: int | None
    exact_stride: int
    type: int
    mode: int
    padding: int
    tile_rows: int
    next: int


class Images(Struct):
    """`Images` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("jobs", c_void_p),
        ("count", c_int64),
        ("image", c_int64),
    )
    jobs: int | None
    count: int
    image: int


class Classification(Struct):
    """`Classification` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("nodes", c_void_p),
        ("node_strides", c_int64 * 2),
        ("mapped", c_void_p),
        ("mapped_stride", c_int64),
        ("rim", c_void_p),
        ("rim_stride", c_int64),
        ("count", c_int64),
        ("rows", c_int64),
        ("columns", c_int64),
        ("height", c_int64),
        ("width", c_int64),
        ("source_height", c_double),
        ("source_width", c_double),
        ("tolerance", c_double),
        ("padding", c_int32),
        ("cells", c_void_p),
        ("scratch", c_void_p),
    )
    nodes: int | None
    node_strides: Numbers
    mapped: int | None
    mapped_stride: int
    rim: int | None
    rim_stride: int
    count: int
    rows: int
    columns: int
    height: int
    width: int
    source_height: float
    source_width: float
    tolerance: float
    padding: int
    cells: int | None
    scratch: int | None


class Laying(Struct):
    """`Laying` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("nodes", c_void_p),
        ("cells", c_void_p),
        ("exact", c_void_p),
        ("exact_count", c_int64),
        ("grid", c_void_p),
        ("mapped", c_void_p),
        ("count", c_int64),
        ("rows", c_int64),
        ("columns", c_int64),
        ("height", c_int64),
        ("width", c_int64),
        ("is_transposed", c_int64),
        ("next", c_int64),
    )
    nodes: int | None
    cells: int | None
    exact: int | None
    exact_count: int
    grid: int | None
    mapped: int | None
    count: int
    rows: int
    columns: int
    height: int
    width: int
    is_transposed: int
    next: int


class Part(Struct):
    """`Part` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("kind", c_int32),
        ("flags", c_int32),
        ("factor", c_int32),
        ("n", c_int32),
        ("m", c_int32),
        ("constant", c_double),
        ("cells", c_double * 2),
        ("centre", c_double * 2),
    )
    kind: int
    flags: int
    factor: int
    n: int
    m: int
    constant: float
    cells: Numbers
    centre: Numbers


class Cameras(Struct):
    """`Cameras` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("parts", c_void_p),
        ("part_count", c_int64),
        ("is_double", c_int64),
        ("cameras", c_int64),
        ("intrinsics", c_void_p),
        ("parameters", c_void_p),
        ("parameter_count", c_int64),
        ("constants", c_void_p),
        ("constant_count", c_int64),
        ("usable", c_void_p),
        ("safe_radius_sq", c_void_p),
        ("image_radius_sq", c_void_p),
        ("limits2", c_void_p),
        ("extent", c_void_p),
        ("table", c_void_p),
        ("stagewise", c_void_p),
        ("image_circle_sq", c_void_p),
        ("chart_safe_radius_sq", c_void_p),
        ("chart_most2", c_void_p),
        ("chart_table", c_void_p),
    )
    parts: int | None
    part_count: int
    is_double: int
    cameras: int
    intrinsics: int | None
    parameters: int | None
    parameter_count: int
    constants: int | None
    constant_count: int
    usable: int | None
    safe_radius_sq: int | None
    image_radius_sq: int | None
    limits2: int | None
    extent: int | None
    table: int | None
    stagewise: int | None
    image_circle_sq: int | None
    chart_safe_radius_sq: int | None
    chart_most2: int | None
    chart_table: int | None


class Domain(Struct):
    """`Domain` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("parts", c_void_p),
        ("part_count", c_int64),
        ("is_double", c_int64),
        ("cameras", c_int64),
        ("parameters", c_void_p),
        ("parameter_count", c_int64),
        ("constants", c_void_p),
        ("constant_count", c_int64),
        ("is_chart", c_int64),
        ("is_radial", c_int64),
        ("ends", c_void_p),
        ("usual_ends", c_void_p),
        ("folds", c_void_p),
        ("most", c_double),
        ("radii", c_void_p),
        ("coarse", c_void_p),
        ("even", c_void_p),
        ("safe_radius_sq", c_void_p),
        ("image_radius_sq", c_void_p),
        ("image_circle_sq", c_void_p),
        ("table", c_void_p),
        ("limits2", c_void_p),
        ("extent", c_void_p),
        ("stagewise", c_void_p),
    )
    parts: int | None
    part_count: int
    is_double: int
    cameras: int
    parameters: int | None
    parameter_count: int
    constants: int | None
    constant_count: int
    is_chart: int
    is_radial: int
    ends: int | None
    usual_ends: int | None
    folds: int | None
    most: float
    radii: int | None
    coarse: int | None
    even: int | None
    safe_radius_sq: int | None
    image_radius_sq: int | None
    image_circle_sq: int | None
    table: int | None
    limits2: int | None
    extent: int | None
    stagewise: int | None


class Rows(Struct):
    """`Rows` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("cameras", c_void_p),
        ("rows", c_void_p),
        ("row_strides", c_int64 * 3),
        ("results", c_void_p),
        ("result_strides", c_int64 * 3),
        ("valid", c_void_p),
        ("solution", c_void_p),
        ("cotangents", c_void_p),
        ("cotangent_strides", c_int64 * 3),
        ("sums", c_void_p),
        ("count", c_int64),
        ("tile", c_int64),
        ("direction", c_int64),
        ("next", c_void_p),
    )
    cameras: int | None
    rows: int | None
    row_strides: Numbers
    results: int | None
    result_strides: Numbers
    valid: int | None
    solution: int | None
    cotangents: int | None
    cotangent_strides: Numbers
    sums: int | None
    count: int
    tile: int
    direction: int
    next: int | None


class Move(Struct):
    """`Move` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("from_", c_void_p),
        ("to", c_void_p),
        ("turns", c_void_p),
        ("turn_strides", c_int64 * 3),
        ("cameras", c_int64),
        ("form", c_int64),
        ("height", c_double),
        ("width", c_double),
        ("rows", c_void_p),
        ("row_strides", c_int64 * 3),
        ("results", c_void_p),
        ("result_strides", c_int64 * 3),
        ("valid", c_void_p),
        ("count", c_int64),
        ("tile", c_int64),
        ("next", c_void_p),
    )
    from_: int | None
    to: int | None
    turns: int | None
    turn_strides: Numbers
    cameras: int
    form: int
    height: float
    width: float
    rows: int | None
    row_strides: Numbers
    results: int | None
    result_strides: Numbers
    valid: int | None
    count: int
    tile: int
    next: int | None


class Lattices(Struct):
    """`Lattices` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("move", Move),
        ("cells", Classification),
        ("first_row", c_int64),
        ("learns", c_int64),
        ("narrow", c_void_p),
        ("exact", c_void_p),
        ("used", c_void_p),
        ("jobs", c_void_p),
        ("job_count", c_int64),
    )
    move: Move
    cells: Classification
    first_row: int
    learns: int
    narrow: int | None
    exact: int | None
    used: int | None
    jobs: int | None
    job_count: int


class Turned(Struct):
    """`Turned` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("turn", c_void_p),
        ("rows", c_void_p),
        ("results", c_void_p),
        ("strides", c_int64 * 2),
        ("count", c_int64),
        ("is_double", c_int64),
        ("form", c_int64),
    )
    turn: int | None
    rows: int | None
    results: int | None
    strides: Numbers
    count: int
    is_double: int
    form: int


class Together(Struct):
    """`Together` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("jobs", c_void_p),
        ("job_count", c_int64),
        ("is_whole", c_int64),
        ("moves", c_void_p),
        ("move_count", c_int64),
        ("turned", c_void_p),
        ("turned_count", c_int64),
        ("lattices", Lattices),
    )
    jobs: int | None
    job_count: int
    is_whole: int
    moves: int | None
    move_count: int
    turned: int | None
    turned_count: int
    lattices: Lattices


class Draws(Struct):
    """`Draws` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("values", c_void_p),
        ("first", c_int64 * 10),
        ("cameras", c_int64),
        ("count", c_int64),
        ("height", c_double),
        ("width", c_double),
        ("is_each", c_int64),
        ("sized", c_void_p),
        ("reach", c_void_p),
        ("coefficients", c_void_p),
        ("sensitivity", c_void_p),
        ("ends", c_void_p),
        ("base", c_void_p),
        ("border", c_void_p),
        ("places", c_void_p),
        ("domain", Domain),
        ("tries", c_void_p),
        ("tried", c_void_p),
        ("allowed", c_void_p),
        ("share", c_double),
        ("source", c_void_p),
        ("source_height", c_double),
        ("source_width", c_double),
        ("looked_at", c_void_p),
        ("factors", c_void_p),
        ("filled", c_void_p),
        ("room", c_void_p),
        ("made", Cameras),
        ("rotations", c_void_p),
        ("distortion", c_void_p),
        ("followed", c_int64),
    )
    values: int | None
    first: Numbers
    cameras: int
    count: int
    height: float
    width: float
    is_each: int
    sized: int | None
    reach: int | None
    coefficients: int | None
    sensitivity: int | None
    ends: int | None
    base: int | None
    border: int | None
    places: int | None
    domain: Domain
    tries: int | None
    tried: int | None
    allowed: int | None
    share: float
    source: int | None
    source_height: float
    source_width: float
    looked_at: int | None
    factors: int | None
    filled: int | None
    room: int | None
    made: Cameras
    rotations: int | None
    distortion: int | None
    followed: int


class Poses(Struct):
    """`Poses` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("cameras", c_void_p),
        ("points", c_void_p),
        ("rays", c_void_p),
        ("pixels", c_void_p),
        ("weights", c_void_p),
        ("point_rows", c_int64),
        ("row_count", c_int64),
        ("count", c_int64),
        ("task", c_int64),
        ("loss", c_int64),
        ("steps", c_int64),
        ("loss_scale", c_double),
        ("settled", c_double),
        ("nothing", c_double),
        ("damping", c_double),
        ("threshold", c_double),
        ("rotations", c_void_p),
        ("translations", c_void_p),
        ("valid", c_void_p),
        ("costs", c_void_p),
        ("vectors", c_void_p),
        ("rms", c_void_p),
        ("inliers", c_void_p),
        ("covariance", c_void_p),
        ("next", c_void_p),
        ("left", c_void_p),
    )
    cameras: int | None
    points: int | None
    rays: int | None
    pixels: int | None
    weights: int | None
    point_rows: int
    row_count: int
    count: int
    task: int
    loss: int
    steps: int
    loss_scale: float
    settled: float
    nothing: float
    damping: float
    threshold: float
    rotations: int | None
    translations: int | None
    valid: int | None
    costs: int | None
    vectors: int | None
    rms: int | None
    inliers: int | None
    covariance: int | None
    next: int | None
    left: int | None


class Views(Struct):
    """`Views` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("cameras", c_void_p),
        ("points", c_void_p),
        ("point_strides", c_int64 * 2),
        ("rotations", c_void_p),
        ("translations", c_void_p),
        ("pixels", c_void_p),
        ("given", c_void_p),
        ("residuals", c_void_p),
        ("weights", c_void_p),
        ("valid", c_void_p),
        ("costs", c_void_p),
        ("problems", c_int64),
        ("views", c_int64),
        ("count", c_int64),
        ("loss", c_int64),
        ("loss_scale", c_double),
        ("learnt", c_void_p),
        ("columns", c_int64),
        ("view", c_void_p),
        ("shared", c_void_p),
        ("left", c_void_p),
    )
    cameras: int | None
    points: int | None
    point_strides: Numbers
    rotations: int | None
    translations: int | None
    pixels: int | None
    given: int | None
    residuals: int | None
    weights: int | None
    valid: int | None
    costs: int | None
    problems: int
    views: int
    count: int
    loss: int
    loss_scale: float
    learnt: int | None
    columns: int
    view: int | None
    shared: int | None
    left: int | None


class Steps(Struct):
    """`Steps` of the headers."""

    __slots__ = ()
    _fields_ = (
        ("view", c_void_p),
        ("shared", c_void_p),
        ("damping", c_void_p),
        ("problems", c_int64),
        ("views", c_int64),
        ("width", c_int64),
        ("columns", c_int64),
        ("of_views", c_void_p),
        ("of_shared", c_void_p),
        ("rest", c_void_p),
        ("left", c_void_p),
    )
    view: int | None
    shared: int | None
    damping: int | None
    problems: int
    views: int
    width: int
    columns: int
    of_views: int | None
    of_shared: int | None
    rest: int | None
    left: int | None


STRUCTS = Agreement, Job, Images, Classification, Laying, Part, Cameras, Domain, Rows, Move, Lattices, Turned, Together, Draws, Poses, Views, Steps


class Library(Calls):
    """The compiled library."""

    types = {
        "camtorch_sample": (c_int32, [POINTER(Job)]),
        "camtorch_sample_images": (None, [POINTER(Images)]),
        "camtorch_classify": (c_int32, [POINTER(Classification)]),
        "camtorch_lay": (None, [POINTER(Laying)]),
        "camtorch_geometry": (c_int64, [POINTER(Rows)]),
        "camtorch_moves": (c_int64, [POINTER(Move)]),
        "camtorch_lattices": (c_int64, [POINTER(Lattices)]),
        "camtorch_domain": (None, [POINTER(Domain)]),
        "camtorch_draws": (c_int64, [POINTER(Draws)]),
        "camtorch_consensus": (None, [POINTER(Agreement)]),
        "camtorch_poses": (None, [POINTER(Poses)]),
        "camtorch_views": (None, [POINTER(Views)]),
        "camtorch_steps": (None, [POINTER(Steps)]),
        "camtorch_use": (c_int32, [c_char_p]),
        "camtorch_sources": (c_uint32, []),
        "camtorch_layout": (c_uint32, []),
        "camtorch_variant": (c_char_p, []),
        "camtorch_turns": (None, [c_void_p, c_int64, c_void_p, c_int64]),
        "camtorch_together": (c_int64, [POINTER(Together)]),
    }
    camtorch_sample: Callable[[Job], int]
    camtorch_sample_images: Callable[[Images], None]
    camtorch_classify: Callable[[Classification], int]
    camtorch_lay: Callable[[Laying], None]
    camtorch_geometry: Callable[[Rows], int]
    camtorch_moves: Callable[[Move], int]
    camtorch_lattices: Callable[[Lattices], int]
    camtorch_domain: Callable[[Domain], None]
    camtorch_draws: Callable[[Draws], int]
    camtorch_consensus: Callable[[Agreement], None]
    camtorch_poses: Callable[[Poses], None]
    camtorch_views: Callable[[Views], None]
    camtorch_steps: Callable[[Steps], None]
    camtorch_use: Callable[[bytes], int]
    camtorch_sources: Callable[[], int]
    camtorch_layout: Callable[[], int]
    camtorch_variant: Callable[[], bytes]
    camtorch_turns: Callable[[int, int, int, int], None]
    camtorch_together: Callable[[Together], int]
