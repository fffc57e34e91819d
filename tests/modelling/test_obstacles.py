"""Obstacles against closed forms and sampled surfaces; derivatives, recompilation, a solve."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import At, assert_complains, cases
from PIL import Image
from scipy.spatial.transform import Rotation

from mjx_drax import from_function, obstacles, solve
from mjx_drax.modelling.maps import to_squares

L_SHAPE = [[0, 0], [2, 0], [2, 0.5], [1, 0.5], [0.6, 1.5], [0, 1.5]]
TURN = [0.5, -0.3, 0.7, 0.2]
SHAPES = {
    "circle": obstacles.circle([0.3, 0.2], 0.7),
    "sphere": obstacles.circle([0.3, 0.2, 0.1], 0.7),
    "box": obstacles.box([0.3, 0.2], [0.8, 0.4], 0.5),
    "square": obstacles.box([0.3, 0.2], [0.5, 0.5]),
    "flat box": obstacles.box([0.3, 0.2], [0.8, 0.0]),
    "box in space": obstacles.box([0.3, 0.2, 0.1], [0.8, 0.4, 0.3], TURN),
    "capsule": obstacles.capsule([0.0, 0.2], [1.0, 0.6], 0.3),
    "segment": obstacles.capsule([0.0, 0.2], [1.0, 0.2], 0.0),
    "point": obstacles.capsule([0.3, 0.2], [0.3, 0.2], 0.0),
    "capsule in space": obstacles.capsule([0.0, 0.2, 0.1], [1.0, 0.6, -0.3], 0.3),
    "polygon": obstacles.polygon(L_SHAPE),
    "grid": obstacles.grid(np.random.default_rng(0).normal(size=(7, 5)), 0.4, [-0.7, -0.6]),
    "grid in space": obstacles.grid(
        np.random.default_rng(0).normal(size=(5, 4, 3)), 0.5, [-0.7, -0.6, -0.5]
    ),
}
each = pytest.mark.parametrize("name", SHAPES)


def close(a, b, tolerance=2e-6):
    np.testing.assert_allclose(np.asarray(a), b, atol=tolerance)


def points(obstacle, count=200, seed=1):
    return np.random.default_rng(seed).uniform(-1.5, 2.5, (count, obstacle.dimension))


def on_the_boundary(corners, count=4000):
    """Points (n, 2) on the edges of a polygon."""
    t = np.linspace(0, 1, count)[:, None]
    ends = np.roll(corners, -1, axis=0)
    return np.concatenate([a + t * (b - a) for a, b in zip(corners, ends, strict=True)])


def within(corners, p):
    """Whether a line from p to the right crosses the edges of a polygon an odd number of times."""
    a, b = np.array(corners, float), np.roll(corners, -1, axis=0)
    spans = (a[:, 1] > p[1]) != (b[:, 1] > p[1])
    crossing = a[spans, 0] + (p[1] - a[spans, 1]) / (b - a)[spans, 1] * (b - a)[spans, 0]
    return (crossing > p[0]).sum() % 2 == 1


def sampled(corners, places):
    """Signed distances of places from a polygon whose edges are sampled."""
    corners = np.array(corners, float)
    surface = on_the_boundary(corners)
    least = np.array([np.linalg.norm(surface - p, axis=1).min() for p in places])
    return np.where([within(corners, p) for p in places], -least, least)


def test_circles_and_capsules_against_closed_forms():
    for name in ("circle", "sphere"):
        place, radius = SHAPES[name].numbers
        p = points(SHAPES[name])
        close(SHAPES[name](p), np.linalg.norm(p - place, axis=1) - radius)
    for name in ("capsule", "capsule in space", "segment", "point"):
        a, b, radius = SHAPES[name].numbers
        p, axis = points(SHAPES[name]), a + np.linspace(0, 1, 4001)[:, None] * (b - a)
        least = [np.linalg.norm(axis - q, axis=1).min() for q in p]
        close(SHAPES[name](p), least - radius, 1e-5)


@pytest.mark.slow
def test_boxes_and_polygons_against_their_sampled_edges():
    turn = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    corners = np.array([0.3, 0.2]) + [[-0.8, -0.4], [0.8, -0.4], [0.8, 0.4], [-0.8, 0.4]] @ turn.T
    p = points(SHAPES["box"])
    wanted = sampled(corners, p)
    close(SHAPES["box"](p), wanted, 1e-4)
    close(obstacles.polygon(corners)(p), wanted, 1e-4)
    wanted = sampled(L_SHAPE, p)
    assert 10 < (wanted < 0).sum() < 100
    for order in (L_SHAPE, L_SHAPE[::-1], [*L_SHAPE, L_SHAPE[0]]):
        close(obstacles.polygon(order)(p), wanted, 1e-4)
    with_a_straight_corner = [[0, 0], [1, 0], *L_SHAPE[1:]]
    close(obstacles.polygon(with_a_straight_corner)(p), wanted, 1e-4)
    below = np.array([[1.0, -0.25], [1.0, 0.25]])
    close(obstacles.polygon(with_a_straight_corner)(below), [0.25, -0.25])


def test_boxes_in_space_against_their_own_frame():
    p = points(SHAPES["box in space"])
    seen = Rotation.from_quat(TURN, scalar_first=True).inv().apply(p - [0.3, 0.2, 0.1])
    half = np.array([0.8, 0.4, 0.3])
    outside = np.linalg.norm(seen - np.clip(seen, -half, half), axis=1)
    inside = (half - np.abs(seen)).min(axis=1)
    close(SHAPES["box in space"](p), np.where(outside > 0, outside, -inside))


@pytest.mark.slow
@each
def test_derivatives_are_those_of_the_values(name):
    """First and second, in float64, against central differences; reverse mode agrees."""
    with jax.enable_x64(True):
        obstacle, h = SHAPES[name], 1e-6
        slope = jax.jit(jax.vmap(jax.jacfwd(obstacle)))
        curvature = jax.jit(jax.vmap(jax.jacfwd(jax.jacfwd(obstacle))))
        p = points(obstacle, 100)
        steps = h * np.eye(obstacle.dimension)
        first = np.stack([(obstacle(p + s) - obstacle(p - s)) / (2 * h) for s in steps], -1)
        second = np.stack([(slope(p + s) - slope(p - s)) / (2 * h) for s in steps], -1)
        close(slope(p), first, 1e-7)
        close(curvature(p), second, 1e-5)
        close(jax.vmap(jax.grad(obstacle))(p), slope(p), 1e-12)


SINGULAR = {
    "circle": [[0.3, 0.2]],
    "sphere": [[0.3, 0.2, 0.1]],
    "square": [[0.3, 0.2], [0.8, 0.7], [0.8, 0.2], [0.3, 0.9], [0.7, 0.6]],
    "flat box": [[0.3, 0.2], [1.1, 0.2], [1.2, 0.2]],
    "box in space": [[0.3, 0.2, 0.1]],
    "capsule": [[0.0, 0.2], [1.0, 0.6], [0.5, 0.4]],
    "segment": [[0.0, 0.2], [1.0, 0.2], [0.5, 0.2], [1.5, 0.2]],
    "point": [[0.3, 0.2]],
    "capsule in space": [[0.0, 0.2, 0.1], [1.0, 0.6, -0.3], [0.5, 0.4, -0.1]],
    "polygon": [*L_SHAPE, [1, 0], [0.25, 0.25], [0.6, -0.5], [1.5, 1.5]],
}


@pytest.mark.parametrize("name", SINGULAR)
def test_where_nothing_is_smooth_derivatives_are_finite_and_lead_out(name):
    """At centres, corners, edges and axes, exactly there and next to them, in float32."""
    obstacle = SHAPES[name]
    value = jax.jit(obstacle)
    slope = jax.jit(jax.jacfwd(obstacle))
    curvature = jax.jit(jax.jacfwd(jax.jacfwd(obstacle)))
    shifts = itertools.product((0.0, 1e-20, 1e-12, -1e-7), repeat=obstacle.dimension)
    for place, shift in itertools.product(SINGULAR[name], shifts):
        p = jnp.array(place) + jnp.array(shift)
        assert np.isfinite(curvature(p)).all()
        g = np.asarray(slope(p))
        assert 0.5 < np.linalg.norm(g) < 1.001
        assert value(p + 1e-2 * g) > value(p) + 1e-3


@pytest.mark.slow
def test_grids_are_exact_at_their_values_and_smooth_between():
    rng = np.random.default_rng(2)
    for name in ("grid", "grid in space"):
        obstacle = SHAPES[name]
        inner = obstacle.numbers[0].shape
        places = np.array(list(itertools.product(*(range(n - 2) for n in inner))))
        shape = tuple(n - 2 for n in inner)
        values = np.random.default_rng(0).normal(size=shape).ravel()
        _, cell, origin = obstacle.numbers
        close(obstacle(origin + cell * places), values, 1e-5)
    with jax.enable_x64(True):  # value, slope and curvature are continuous where cells meet
        obstacle, step = SHAPES["grid"], np.array([1e-9, 0])
        seam = np.stack([-0.7 + 0.4 * np.arange(1, 6), rng.uniform(-0.6, 1.0, 5)], -1)
        for f in (obstacle, jax.jacfwd(obstacle), jax.jacfwd(jax.jacfwd(obstacle))):
            before, after = jax.jit(jax.vmap(jax.vmap(f)))(np.stack([seam - step, seam + step]))
            close(before, after, 1e-6)


@pytest.mark.slow
def test_linear_grids_are_exact_and_far_points_lie_farther():
    x, y = np.meshgrid(0.5 * np.arange(5), 0.5 * np.arange(4), indexing="ij")
    plane = obstacles.grid(0.6 * x - 0.8 * y + 0.1, 0.5, [0, 0])
    p = np.random.default_rng(0).uniform([0, 0], [2, 1.5], (50, 2))
    close(plane(p), p @ [0.6, -0.8] + 0.1)
    far = np.array([[5.0, 1.5], [5.0, 5.5]])  # 3 from the border, and (3, 4) from its corner
    close(plane(far), plane(np.array([[2.0, 1.5]] * 2)) + np.array([3.0, 5.0]))


def test_distances_to_dark_pixels_are_exact_at_centres():
    rng = np.random.default_rng(0)
    for share in (0.02, 0.3, 0.9):
        there = rng.random((13, 17)) < share
        there[4, 5] = True
        dark = np.argwhere(there)
        found = to_squares(there)
        for i, j in itertools.product(range(13), range(17)):
            gaps = np.maximum(np.abs(dark - [i, j]) - 0.5, 0) * (dark != [i, j])
            assert abs(found[i, j] - np.linalg.norm(gaps, axis=1).min()) < 1e-12


def test_images_are_upright_and_near_the_true_distance(tmp_path):
    dark = np.zeros((20, 30), bool)
    dark[2:7, 10:18] = True  # columns 10 to 17, and the rows 2 to 6 from above
    true = obstacles.box([1 + 1.4, 2 + 1.55], [0.4, 0.25])
    p = np.random.default_rng(0).uniform([1.05, 2.05], [3.95, 3.95], (2000, 2))
    pixels = np.where(dark, 20, 250).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "map.png")
    deep = pixels.astype(np.uint16) * 257
    Image.fromarray(deep).save(tmp_path / "deep.png")
    files = tmp_path / "map.png", str(tmp_path / "map.png"), tmp_path / "deep.png"
    for picture in (dark, pixels, deep, pixels / 255, *files):
        found = obstacles.image(picture, 0.1, [1, 2])
        error = np.abs(found(p) - true(p))
        assert error.max() < 0.025
        assert error.mean() < 0.001


@pytest.mark.slow
def test_clearances_keep_the_order_and_stack():
    kinds = ("circle", "box", "polygon", "square", "capsule", "flat box")
    listed = [SHAPES[kind] for kind in kinds]
    margins = np.arange(6) / 10
    x, u = jnp.array([9.0, 0.9, -0.4]), jnp.zeros(1)
    wanted = margins - jax.jit(lambda x: jnp.array([one(x[1:]) for one in listed]))(x)
    term = obstacles.clearance(listed, margin=margins, at=(1, 2))
    close(jax.jit(term)(x, u), wanted)
    close(jax.jit(term + (lambda x: x[:1]))(x), [*wanted, 9.0])
    one = obstacles.clearance(SHAPES["sphere"], margin=0.1, at=(2, 0, 1))
    close(one(x), [0.1 - SHAPES["sphere"](x[jnp.array([2, 0, 1])])])


def step(x, u):
    return x + 0.1 * u


def effort(x, u):
    return 0.3 * u


def arrived(x):
    return 10 * (x - jnp.array([1.2, 0.0]))


def planar(shift=0.0, margin=0.1):
    """A disc that goes from (-1.2, 0) to (1.2, 0) between obstacles."""
    wall = [[-0.8, -0.2], [-0.2, -0.9], [-0.7, -0.7]]
    listed = [
        obstacles.circle([0, shift], 0.3),
        obstacles.box([0.6, 0.5], [0.2, 0.3], 0.4 + shift),
        obstacles.polygon(np.array(wall) + shift),
    ]
    return listed, from_function(
        step,
        x_init=[-1.2, 0.0],
        nu=2,
        dt=0.1,
        horizon=1.5,
        running_residual=effort,
        terminal_residual=arrived,
        inequality=obstacles.clearance(listed, margin=margin),
        u_bounds=(-3.0, 3.0),
        x_scatter=(-1.5, 1.5),
    )


def test_other_numbers_do_not_recompile():
    (_, first), (_, second) = planar(), planar(0.1, 0.05)
    assert jax.tree.structure(first) == jax.tree.structure(second)
    shapes = [[np.shape(leaf) for leaf in jax.tree.leaves(p)] for p in (first, second)]
    assert shapes[0] == shapes[1]
    value = jax.jit(lambda problem, x: problem.constraint(x, jnp.zeros(2)))
    at = jnp.zeros(2)
    assert np.abs(value(first, at) - value(second, at)).min() > 1e-3
    assert value._cache_size() == 1


def test_numbers_may_be_traced():
    """An obstacle that moves with the state, and a robot that is a box."""

    @jax.jit
    def gaps(x):
        moving = obstacles.circle([x[0], 1.0], 0.5 * x[1])
        robot = obstacles.box(x[:2], [0.4, 0.2], x[2])
        wedge = obstacles.polygon([[0.0, 0.0], [x[0], 0.0], [0.0, x[1]]])
        return jnp.array([moving(jnp.zeros(2)), robot([1.0, 2.0]), wedge([2.0, 0.0])])

    close(gaps(jnp.array([1.0, 0.5, np.pi / 2])), [2**0.5 - 0.25, 1.1, 1.0])


@pytest.mark.slow
def test_a_plan_around_obstacles_is_certified():
    listed, problem = planar()
    solution = solve(problem, chains=8, seed=0)
    assert solution.certified
    assert solution.best.x[-1, 0] > 1.0
    for one in listed:
        assert one(solution.best.x).min() > 0.1 - 1e-3
    assert listed[0](solution.best.x).min() < 0.11  # the circle is in the way


CROSSED = [[0, 0], [1, 1], [1, 0], [0, 1]]
# fmt: off
WRONG = [
    ("circle-centre", lambda at: obstacles.circle([0] * 4, 1), "centre of the circle", "2 or 3"),
    ("circle-text", lambda at: obstacles.circle("here", 1), "centre of the circle is 'here'"),
    ("circle-radius", lambda at: obstacles.circle([0, 0], -1), "radius of the circle is -1"),
    ("circle-nan", lambda at: obstacles.circle([0, np.nan], 1), "finite"),
    ("box-sizes", lambda at: obstacles.box([0, 0], [1, 1, 1]), "half_sizes of the box", "2 number"),
    ("box-rotation", lambda at: obstacles.box([0, 0, 0], [1, 1, 1], 0.3), "rotation", "4 number"),
    ("box-turn", lambda at: obstacles.box([0, 0, 0], [1, 1, 1], [0] * 4), "must not be zero"),
    ("capsule-b", lambda at: obstacles.capsule([0, 0], [1, 1, 1], 1), "b of the capsule"),
    ("polygon-two", lambda at: obstacles.polygon([[0, 0], [1, 1]]), "(2, 2)", "three"),
    ("polygon-space", lambda at: obstacles.polygon(np.eye(4)[:, 1:]), "(4, 3)", "points"),
    ("polygon-twice", lambda at: obstacles.polygon([[0, 0], [1, 0], [1, 0], [0, 1]]),
     "corners 1 and 2", "remove"),
    ("polygon-crossed", lambda at: obstacles.polygon(CROSSED), "edges 0 and 2", "cross"),
    ("polygon-flat", lambda at: obstacles.polygon([[0, 0], [1, 0], [2, 0]]), "no area", "capsule"),
    ("grid-values", lambda at: obstacles.grid(np.ones(4), 1, [0]), "shape (4,)"),
    ("grid-cell", lambda at: obstacles.grid(np.ones((3, 3)), 0, [0, 0]), "cell of the grid is 0"),
    ("grid-origin", lambda at: obstacles.grid(np.ones((3, 3)), 1, 0), "origin of the grid is 0"),
    ("image-file", lambda at: obstacles.image(at.folder / "no.png", 1), "no.png", "cannot be read"),
    ("image-kind", lambda at: obstacles.image(at.file("a.png", b"no"), 1), "cannot be read"),
    ("image-free", lambda at: obstacles.image(np.ones((4, 4)), 1), "all pixels", "threshold=0.5"),
    ("image-colours", lambda at: obstacles.image(np.ones((4, 4, 3)), 1), "(4, 4, 3)"),
    ("image-text", lambda at: obstacles.image([["a", "b"]] * 2, 1), "the image is", "numbers"),
    ("image-threshold", lambda at: obstacles.image(np.eye(4), 1, threshold=128), "is 128"),
    ("point", lambda at: SHAPES["circle"](np.zeros(3)), "2 dimensions", "(3,)"),
    ("clearance-none", lambda at: obstacles.clearance([]), "at least one"),
    ("clearance-text", lambda at: obstacles.clearance("wall"), "an obstacle is 'w'", "make"),
    ("clearance-number", lambda at: obstacles.clearance(3.0), "an obstacle is 3.0"),
    ("clearance-at", lambda at: obstacles.clearance(SHAPES["sphere"]), "at is (0, 1)", "[3]"),
    ("clearance-at-text", lambda at: obstacles.clearance(SHAPES["circle"], at="xy"), "at is 'xy'"),
    ("clearance-margin", lambda at: obstacles.clearance(SHAPES["circle"], margin=[1, 2]),
     "margin of clearance is [1, 2]", "or 1"),
    ("clearance-far", lambda at: obstacles.clearance(SHAPES["circle"], at=(0, 3))(np.zeros(3)),
     "(0, 3)", "3 numbers"),
    ("clearance-model", lambda at: obstacles.clearance(SHAPES["circle"])(at.robot),
     "Terms(model).clearance"),
]
# fmt: on


@pytest.mark.parametrize(("call", "words"), cases(obstacle=WRONG))
def test_bad_input_gives_one_clear_error(call, words, tmp_path):
    assert_complains(lambda: call(At(tmp_path)), words)
