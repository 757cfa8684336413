"""Tables of named quantities: mirror signs against reflected geometry, places by hand."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hasrl_jax.envs import layout

REFLECTION = np.diag([1.0, -1.0, 1.0])  # of the plane between the legs


def test_signs_are_those_of_reflected_geometry() -> None:
    rng = np.random.default_rng(0)
    point, other = rng.normal(size=(2, 3))
    np.testing.assert_allclose(np.array(layout.VECTOR) * point, REFLECTION @ point)
    # An angular velocity is a product of two vectors, both of which are reflected.
    axial = np.cross(REFLECTION @ point, REFLECTION @ other)
    np.testing.assert_allclose(np.array(layout.AXIAL) * np.cross(point, other), axial)
    turned = Rotation.random(random_state=1)
    reflected = Rotation.from_matrix(REFLECTION @ turned.as_matrix() @ REFLECTION)
    ours, theirs = (rotation.as_quat(canonical=True)[[3, 0, 1, 2]] for rotation in (turned, reflected))
    np.testing.assert_allclose(np.array(layout.QUATERNION) * ours, theirs)
    assert (layout.SAME, layout.NEGATED) == ((1.0,), (-1.0,))


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_parts_and_sums_of_vectors(shape: tuple[int, ...], xp: Any) -> None:
    values = np.random.default_rng(1).normal(size=(*shape, 5)).astype(np.float32)
    vector = xp.asarray(values)
    for index, number in enumerate(layout.numbers(vector)):
        np.testing.assert_array_equal(number, values[..., index])
    np.testing.assert_allclose(layout.total(vector), values.sum(axis=-1), rtol=1e-5)
    np.testing.assert_allclose(layout.summed(vector, xp), values.sum(axis=-1), rtol=1e-5)
    np.testing.assert_array_equal(layout.columns(layout.numbers(vector), xp), values)


def test_places_and_defaults_by_hand() -> None:
    one = layout.Entry("one", "m", layout.VECTOR, noise=0.5)
    two = layout.Entry("two", "", (1.0, -1.0, 1.0, -1.0), legs=True)
    assert layout.size((one, two)) == 7
    assert layout.places((one, two)) == {"one": slice(0, 3), "two": slice(3, 7)}
    np.testing.assert_array_equal(layout.noise((one, two)), [0.5, 0.5, 0.5, 0, 0, 0, 0])
    index, sign = layout.signed_permutation((one, two))
    np.testing.assert_array_equal(index, [0, 1, 2, 5, 6, 3, 4])
    np.testing.assert_array_equal(sign, [1, -1, 1, 1, -1, 1, -1])
    assert (one.legs, one.mean, one.std, one.scale, two.noise) == (False, 0.0, 1.0, 1.0, 0.0)
    x, y = np.arange(6.0).reshape(2, 3), np.arange(6.0, 12).reshape(2, 3)
    np.testing.assert_array_equal(layout.columns([x, y], np), np.stack([x, y], axis=-1))
