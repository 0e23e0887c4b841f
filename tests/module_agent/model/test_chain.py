"""A chain survives plain data to the last bit, broken data is refused by name, and walks agree with paths."""

import json
from typing import Any

import numpy as np
import pytest

from module_agent.model.chain import BASE, Chain, ChainError


def _chain() -> Chain:
    """A tree of two roots: 0 - 1 - (2, 4), and 3 alone; module 2 is reversed."""
    rng = np.random.default_rng(3)
    home = np.tile(np.eye(4), (5, 1, 1))
    home[:, :3, 3] = rng.normal(size=(5, 3))
    parent = (BASE, 0, 1, BASE, 1)
    backwards = (False, False, True, False, False)
    axis, point, gravity = rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), rng.normal(size=3)
    return Chain(tuple("ABCDE"), parent, backwards, axis, point, home, gravity)


def test_a_chain_survives_plain_data_to_the_last_bit() -> None:
    chain = _chain()
    again = Chain.from_dict(json.loads(json.dumps(chain.to_dict())))
    assert again[:3] == chain[:3]
    for one, other in zip(again[3:], chain[3:], strict=True):
        np.testing.assert_array_equal(one, other)
        assert not one.flags.writeable


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"axis": [[0.0, 0.0, 1.0]]}, r"axis has shape \(1, 3\), \(5, 3\)"),
        ({"point": [[0.0], [0.0, 1.0]]}, "point has rows of different lengths"),
        ({"gravity": [0.0, 0.0, float("nan")]}, "gravity has a value that is not finite"),
        ({"serials": ["A", "B", "A", "D", "E"]}, "a serial twice"),
        ({"parent": [1, 0, 1, -1, 1]}, "every parent before its children"),
        ({"parent": [-2, 0, 1, -1, 1]}, "every parent before its children"),
        ({"reversed": [False]}, "reversed has shape"),
    ],
)
def test_data_that_describes_no_chain_is_refused_by_the_name_of_the_field(
    changed: dict[str, Any], message: str
) -> None:
    with pytest.raises(ChainError, match=message):
        Chain.from_dict(_chain().to_dict() | changed)


def test_the_walks_agree_with_the_tree() -> None:
    chain = _chain()
    assert (chain.roots, chain.linked, chain.leaves) == ((0, 3), (1, 2, 4), (2, 3, 4))
    assert [chain.children(body) for body in range(BASE, 5)] == [(0, 3), (1,), (2, 4), (), (), ()]
    assert chain.ancestors(BASE) == ()
    assert [chain.ancestors(body) for body in range(5)] == [(0,), (0, 1), (0, 1, 2), (3,), (0, 1, 4)]
    assert [chain.descendants(joint) for joint in range(5)] == [(0, 1, 2, 4), (1, 2, 4), (2,), (3,), (4,)]
    assert [chain.carrier(module) for module in range(5)] == [BASE, 0, 2, BASE, 1]
