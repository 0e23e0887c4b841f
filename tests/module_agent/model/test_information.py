"""Square-root information: exact however it is divided up, joint by joint, in any order, and as bytes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import Generator, default_rng
from scipy.spatial.transform import Rotation

from module_agent.model.chain import Array, Chain
from module_agent.model.errors import DataError
from module_agent.model.information import (
    JointInformation,
    compress,
    gather,
    gather_joint,
    merge,
    merge_joint,
)
from module_agent.model.regressor import torque_regressor
from module_agent.torque_information.serialisation import MAX_BYTES, pack, unpack
from module_agent.wire.information_messages import Information

# Some hundred additions of doubles, with room; the bar is 1e-10.
EXACT = 1e-12


def random_tree(rng: Generator, joints: int) -> Chain:
    axis = rng.normal(size=(joints, 3))
    home = np.tile(np.eye(4), (joints, 1, 1))
    home[:, :3, :3] = Rotation.random(joints, rng=rng).as_matrix()
    return Chain(
        serials=tuple(f"M{i}" for i in range(joints)),
        parent=tuple(int(rng.integers(-1, i)) for i in range(joints)),
        reversed=(False,) * joints,
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        point=rng.uniform(-0.5, 0.5, (joints, 3)),
        imu_home=home,
        gravity=Rotation.random(rng=rng).apply([0.0, 0.0, 9.81]),
    )


def motion(rng: Generator, samples: int, joints: int) -> list[Array]:
    return [rng.normal(size=(samples, joints)) for _ in range(4)]


def far(one: JointInformation, other: JointInformation) -> float:
    """How different two are, relative to their size: what they say is R^T R, R^T z and |tau|^2.

    How |tau|^2 divides into z and the rest is up to rounding where columns depend on each other.
    """
    assert one.samples == other.samples
    said = [(i.r.T @ i.r, i.r.T @ i.z, np.atleast_1d(i.z @ i.z + i.rest)) for i in (one, other)]
    return max(
        float(np.linalg.norm(a - b)) / max(float(np.linalg.norm(b)), 1e-300)
        for a, b in zip(*said, strict=True)
    )


@pytest.mark.parametrize("samples", [7, 700])
def test_a_constant_torque_of_each_joint_is_one_more_column(samples: int) -> None:
    """One joint after the other, by its own rows; 700 samples are several blocks."""
    rng = default_rng(samples)
    chain = random_tree(rng, 4)
    q, qd, qdd, tau = motion(rng, samples, 4)
    together = gather(chain, q, qd, qdd, tau, with_offset=True)
    for joint, found in enumerate(together):
        own = gather_joint(chain, joint, q, qd, qdd, tau[:, joint], further=np.ones((samples, 1)))
        assert found.r.shape[1] == 10 * 4 + 1
        assert far(found, own) < EXACT
    # The offset is found where it is, and the bodies' parameters are those of torques without it.
    phi, offset_nm = rng.normal(size=40), np.array([0.5, -0.2, 0.1, 0.3])
    tau = torque_regressor(chain, q, qd, qdd) @ phi + offset_nm
    for joint, found in enumerate(gather(chain, q, qd, qdd, tau, with_offset=True)):
        misfit = found.r @ np.append(phi, offset_nm[joint]) - found.z
        assert np.abs(misfit).max() < 1e-9


@settings(deadline=None, max_examples=25)
@given(st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_a_joint_alone_gathers_what_all_together_gather_of_it(joints: int, seed: int) -> None:
    rng = default_rng(seed)
    chain = random_tree(rng, joints)
    q, qd, qdd, tau = motion(rng, 150, joints)
    merged = gather(chain, q, qd, qdd, tau)
    for joint in range(joints):
        assert far(gather_joint(chain, joint, q, qd, qdd, tau[:, joint]), merged[joint]) < EXACT


def test_a_joint_gathers_as_well_in_many_small_blocks(rng: Generator) -> None:
    """40 joints: the whole regressor is built of 125 samples at a time, and squeezed after 2048."""
    chain = random_tree(rng, 40)
    q, qd, qdd, tau = motion(rng, 2200, 40)
    own = gather_joint(chain, 3, q, qd, qdd, tau[:, 3])
    rows = np.concatenate(
        [
            torque_regressor(chain, q[k : k + 50], qd[k : k + 50], qdd[k : k + 50])[:, 3]
            for k in range(0, 2200, 50)
        ]
    )
    assert np.linalg.norm(own.r.T @ own.r - rows.T @ rows) < EXACT * np.linalg.norm(rows.T @ rows)
    assert np.linalg.norm(own.r.T @ own.z - rows.T @ tau[:, 3]) < EXACT * np.linalg.norm(rows.T @ tau[:, 3])


@settings(deadline=None, max_examples=25)
@given(st.permutations(range(6)), st.lists(st.integers(1, 400), min_size=6, max_size=6), st.integers(0, 99))
def test_pieces_in_any_order_say_what_the_whole_says(order: list[int], sizes: list[int], seed: int) -> None:
    rng = default_rng(seed)
    chain = random_tree(rng, 3)
    whole = motion(rng, sum(sizes), 3)
    ends = np.cumsum(sizes)
    pieces = [gather(chain, *(s[end - n : end] for s in whole)) for end, n in zip(ends, sizes, strict=True)]
    total = pieces[order[0]]
    for k in order[1:]:
        total = merge(total, pieces[k])
    at_once = merge(*(pieces[k] for k in order))
    for one, all_six, other in zip(total, at_once, gather(chain, *whole), strict=True):
        assert far(one, other) < EXACT
        assert far(all_six, other) < EXACT


def test_further_columns_follow_those_of_the_bodies(rng: Generator) -> None:
    chain = random_tree(rng, 2)
    q, qd, qdd, tau = motion(rng, 100, 2)
    friction = np.zeros((100, 2, 2))
    friction[:, 0, 0], friction[:, 1, 1] = qd.T
    wide = np.concatenate([torque_regressor(chain, q, qd, qdd), friction], axis=2)
    half = merge(compress(wide[:40], tau[:40]), compress(wide[40:], tau[40:]))
    for one, other in zip(half, compress(wide, tau), strict=True):
        assert one.r.shape[1] == 22
        assert far(one, other) < EXACT
        assert far(unpack(pack(one)), one) == 0.0
    with pytest.raises(ValueError, match=r"in \[20, 22\] columns cannot be merged"):
        merge_joint(half[0], gather(chain, q, qd, qdd, tau)[0])


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 5), st.integers(1, 60), st.integers(0, 2**32 - 1))
def test_the_bytes_hold_every_double_as_it_is(joints: int, samples: int, seed: int) -> None:
    rng = default_rng(seed)
    chain = random_tree(rng, joints)
    for one in gather(chain, *motion(rng, samples, joints)):
        other = unpack(pack(one))
        assert np.array_equal(one.r, other.r)
        assert np.array_equal(one.z, other.z)
        assert (one.rest, one.samples) == (other.rest, other.samples)
        assert not other.r.flags.writeable


@settings(deadline=None, max_examples=100)
@given(st.binary(max_size=400))
def test_arbitrary_bytes_are_refused_or_are_information(block: bytes) -> None:
    try:
        found = unpack(block)
    except DataError:
        return
    assert np.isfinite(found.r).all()


def test_wrong_bytes_are_refused_with_the_reason(rng: Generator) -> None:
    block = pack(gather(random_tree(rng, 2), *motion(rng, 50, 2))[0])
    for wrong, why in (
        (block[:-8], "are announced"),
        (block[:10], "the head alone"),
        (b"\xff\xff\xff\xff" + block[4:], "rows in"),
        (block[:28] + b"\x63\x00" + block[30:], "out of order"),
        (block[:-8] + np.array([np.nan]).tobytes(), "not finite"),
    ):
        with pytest.raises(DataError, match=why):
            unpack(wrong)


def test_rows_that_are_not_triangular_are_not_packed(rng: Generator) -> None:
    full = JointInformation(rng.normal(size=(5, 10)), np.zeros(5), 0.0, 5)
    with pytest.raises(DataError, match="triangular"):
        pack(full)


def test_the_largest_information_fits_its_message() -> None:
    most = next(m.le for m in Information.model_fields["total_bytes"].metadata if hasattr(m, "le"))
    assert most >= MAX_BYTES
