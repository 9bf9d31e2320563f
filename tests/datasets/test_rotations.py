"""One tolerance for every rotation: rounding is mended and told, anything else is refused."""

from __future__ import annotations

import numpy as np
import pytest
from fathom.datasets.rotations import (
    TOLERANCE,
    UNHEARD,
    complaint,
    complaint_of_quaternion,
    is_rotation,
    note,
    off_rotation,
    off_unit,
    orthonormalised,
)
from scipy.spatial.transform import Rotation

R = Rotation.random(200, random_state=1).as_matrix()


def test_what_is_not_rounded_is_left_as_it_is_without_a_word() -> None:
    for given in (R, R.astype(np.float32).astype(float)):
        off = off_rotation(given)
        assert off.max() < UNHEARD
        assert orthonormalised(given, off) is given
        assert note("truth", off) == ()


@pytest.mark.parametrize("decimals", [6, 4])
def test_a_rounded_matrix_becomes_the_nearest_rotation_with_a_note(decimals: int) -> None:
    off = off_rotation(R.round(decimals))
    mended = orthonormalised(R.round(decimals), off)
    assert is_rotation(off).all()
    assert off_rotation(mended).max() < UNHEARD
    np.testing.assert_allclose(mended, R, rtol=0, atol=1.5 * 10**-decimals)
    (told,) = note("truth", off, "truth")
    assert told == f"truth: {np.count_nonzero(off > UNHEARD)} rotations made exact, off by up to {off.max():.1e}"
    assert (told.kind, told.stream) == ("about" if decimals == 6 else "repaired", "truth")
    assert (told.count, told.of) == (np.count_nonzero(off > UNHEARD), 200)


def test_rounding_to_six_decimals_is_no_news_for_any_quaternion_or_matrix() -> None:
    many = Rotation.random(20_000, random_state=2)
    for off in (off_rotation(many.as_matrix().round(6)), off_unit(many.as_quat().round(6))):
        assert [told.kind for told in note("truth", off)] == ["about"]


def test_the_nearest_rotation_is_that_of_the_least_squares_problem() -> None:
    given = R[:20].round(3)
    nearest = orthonormalised(given, off_rotation(given))
    for rotation, matrix in zip(nearest, given, strict=True):
        aligned, _ = Rotation.align_vectors(matrix.T, np.eye(3))  # an oracle: Kabsch's algorithm on the axes
        np.testing.assert_allclose(rotation, aligned.as_matrix(), atol=1e-12)


def test_a_scale_is_off_by_what_it_is_more_than_one() -> None:
    assert off_rotation(R[0] * (1 + 1e-5)) == pytest.approx(1e-5, rel=1e-3)
    assert off_unit(np.array([0.0, 0, 0, 1 + 1e-5])) == pytest.approx(1e-5)


@pytest.mark.parametrize(
    ("matrix", "says"),
    [
        (2 * np.eye(3), "is 1.5 off orthonormal axes"),
        (np.zeros((3, 3)), "is 0.5 off"),
        (np.diag([1.0, 1.0, -1.0]), "mirrors"),
        (-np.eye(3), "mirrors"),
        (np.array([[1.0, 0.01, 0], [0, 1, 0], [0, 0, 1]]), "is 0.005 off"),
        (np.full((3, 3), np.nan), "is not finite"),
        (np.diag([np.inf, 1, 1]), "is not finite"),
        (np.diag([1e200, 1, 1]), "is inf off"),
    ],
)
def test_what_is_no_rotation_is_said_with_how_far_off_it_is(matrix: np.ndarray, says: str) -> None:
    assert not is_rotation(off_rotation(matrix))
    assert says in complaint(matrix)


def test_a_quaternion_is_held_to_the_same_tolerance() -> None:
    q = np.array([[0, 0, 0, 1.0], [0, 0, 0, 1 + 0.9 * TOLERANCE], [0, 0, 0, 1 + 1.1 * TOLERANCE], [0, 0, 0, np.nan]])
    assert is_rotation(off_unit(q)).tolist() == [True, True, False, False]
    assert complaint_of_quaternion(q[2]).startswith("not a unit quaternion (|q| = 1.0011")
