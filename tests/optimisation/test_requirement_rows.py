"""Rows of requirements, against every rig of small pools."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.optimisation.calls import select
from warpav.core.errors import InputError
from warpav.optimisation._required_points import _require_meetable, _requirement_rows
from warpav.sight import Ghosts, Requirement, Visibility
from warpav.sight._requirement import SIZES_M, Band, TestObject

POST = TestObject("post", SIZES_M["post"])


def ghosts_of(cameras, weights, requirement):
    """Points of requirements that need so many cameras each, in a row."""
    wanted = tuple(
        Requirement(f"r{k}", Band((0.0, 1.0)), 0.5, POST, visible_share=0.5, pixels=100.0, cameras=count, weight=weight)
        for k, (count, weight) in enumerate(zip(cameras, weights, strict=True))
    )
    count = len(requirement)
    return Ghosts(wanted, np.c_[np.arange(count, dtype=float), np.zeros(count)], np.array(requirement))


@given(st.data())
def test_a_rig_satisfies_the_rows_where_it_meets_every_hard_point(data):
    count = data.draw(st.integers(1, 6))
    needs = data.draw(
        st.lists(st.tuples(st.integers(1, 3), st.sampled_from([None, None, 1.0])), min_size=1, max_size=3)
    )
    points = data.draw(st.lists(st.integers(0, len(needs) - 1), min_size=1, max_size=12))
    ghosts = ghosts_of([each[0] for each in needs], [each[1] for each in needs], points)
    flags = data.draw(st.lists(st.integers(0, 2**count - 1), min_size=len(points), max_size=len(points)))
    meets = np.array([[bool(flag >> c & 1) for flag in flags] for c in range(count)])
    rows, points_of_rows = _requirement_rows(meets, ghosts)
    hard = np.flatnonzero(ghosts.is_hard)
    for size in range(count + 1):
        for rig in itertools.combinations(range(count), size):
            chosen = np.isin(np.arange(count), rig)
            expected = (meets[chosen][:, hard].sum(axis=0) >= ghosts.of_each("cameras")[hard]).all()
            assert all(row.coefficient @ chosen >= row.low for row in rows) == expected
    # none of them follows from another by itself
    for one, other in itertools.permutations(rows, 2):
        assert not ((other.coefficient <= one.coefficient).all() and other.low >= one.low)
    for row, ghost in zip(rows, points_of_rows, strict=True):
        np.testing.assert_array_equal(row.coefficient, meets[:, ghost])
        assert f"r{ghosts.requirement[ghost]} at ({ghost:.2f}, 0.00) m" in row.name


def test_the_selection_takes_the_rows(rng):
    meets = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, 1]], bool)
    rows = _requirement_rows(meets, ghosts_of([1], [None], [0, 0, 0]))[0]
    probability = np.zeros((5, 4))
    probability[[0, 1, 2]] = [0.9, 0.8, 0.7, 0.9]  # what meets least sees most
    probability[[3, 4]] = 0.1
    free = select(probability, 2)
    bound = select(probability, 2, rows=rows)
    met = {pair for pair in itertools.combinations(range(5), 2) if meets[list(pair)].any(axis=0).all()}
    assert tuple(sorted(free.cameras)) not in met
    assert tuple(sorted(bound.cameras)) in met


def test_what_no_camera_meets_is_named_with_the_nearest():
    ghosts = ghosts_of([1, 2, 1, 2], [None, None, 3.0, None], [0, 0, 1, 1, 2, 3])
    #        r0 seen, r0 not   r1 twice  r1 once  weight  r3 once, by all that see it
    share = np.array(
        [[0.9, 0.10, 0.9, 0.7, 0.0, 0.8], [0.2, 0.45, 0.8, 0.2, 0.0, 0.0], [0.0, 0.60, 0.6, 0.0, 0.0, 0.0]]
    )
    pixels = np.array([[500.0, 400, 500, 500, 0, 500], [500, 300, 500, 500, 0, 0], [0, 20, 500, 0, 0, 0]])
    visibility = Visibility(share, pixels)
    with pytest.raises(InputError) as caught:
        _require_meetable(visibility, ghosts, 1)
    assert str(caught.value).splitlines() == [
        *(
            f"requirement {name}: cameras: expected at most 1, the cameras of the rig, got 2; lower it or allow more "
            "cameras"
            for name in ("r1", "r3")
        ),
        # 45 of 50 % comes closer than 20 of 100 px
        "requirement r0: 1 point that the pool cannot meet, such as (1.00, 0.00) m, which needs 1 camera and has 0; "
        "camera 1 comes closest with 45% and 300 px",
        "requirement r1: 1 point that the pool cannot meet, such as (3.00, 0.00) m, which needs 2 cameras and has 1; "
        "camera 1 comes closest with 20% and 500 px",
        "requirement r3: 1 point that the pool cannot meet, such as (5.00, 0.00) m, which needs 2 cameras and has 1; "
        "no other camera sees anything there",
    ]
    kept = [0, 2, 4]
    easy = Ghosts(ghosts.requirements, ghosts.position_m[kept], ghosts.requirement[kept])
    _require_meetable(Visibility(share[:, kept], pixels[:, kept]), easy, 2)
