"""Balance of forces against statics on paper; floating and overlapping bodies."""

import numpy as np
import pytest
from test_simulate import FLOOR, GRAVITY, cube, matter, real_towers, towers_as_matter

from derender.model.pose import translation
from derender.physics.bodies import Body
from derender.physics.stability import can_stand, floating, gaps, intersecting


@pytest.mark.parametrize("kind", ["box", "mesh"])
def test_a_solid_balances_exactly_while_its_centre_is_over_its_support(kind):
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.05
    for overhang, stands in ((0.0, True), (0.0499, True), (0.0501, False)):
        top = Body("top", kind, np.full(3, 0.1), translation(overhang, 0, 0.15), corners if kind == "mesh" else None)
        assert can_stand(matter(FLOOR, cube("low", 0, 0.05), top)) is stands


def test_the_harmonic_stack_balances_and_a_little_more_does_not():
    # Blocks of length 1 overhang by 1/2, 1/4, 1/6, 1/8 from the top: each at the very edge of what is below it.
    for share, stands in ((0.999, True), (1.001, False)):
        x, blocks = 0.0, []
        for k in range(5, 0, -1):
            blocks.append(Body(f"b{k}", "box", np.array([1, 0.4, 0.2]), translation(x, 0, 0.1 + 0.2 * (5 - k))))
            x += share * 0.5 / (k - 1) if k > 1 else 0
        assert can_stand(matter(FLOOR, *blocks)) is stands


def test_a_counterweight_holds_what_would_fall_alone():
    base, plank = cube("base", 0, 0.05), Body("plank", "box", np.array([0.3, 0.1, 0.02]), translation(0.06, 0, 0.11))
    assert not can_stand(matter(FLOOR, base, plank))
    weight = cube("weight", -0.06, 0.145, side=0.05, mass=2.0)
    assert can_stand(matter(FLOOR, base, plank, weight))


def test_a_block_slides_where_the_slope_exceeds_friction():
    # The slope runs along an edge of the friction pyramid, so that it is exact there.
    for slope, stands in ((np.arctan(0.79), True), (np.arctan(0.81), False)):
        down = 9.81 * np.array([np.sin(slope), 0, -np.cos(slope)])
        low = Body("low", "box", np.array([0.2, 0.2, 0.02]), translation(0, 0, 0.01))
        assert can_stand(matter(FLOOR, low, gravity=down)) is stands


def test_what_touches_nothing_cannot_stand():
    assert not can_stand(matter(FLOOR, cube("a", 0, 0.3)))
    assert can_stand(matter(FLOOR)) and can_stand(matter(FLOOR, cube("a", 0, 0.3, fixed=True)))


def test_gaps_floating_and_intersecting():
    scene = matter(FLOOR, cube("a", 0, 0.05), cube("b", 0.09, 0.052), cube("c", 0.3, 0.07), cube("d", 0, 0.153))
    found = gaps(scene)
    assert found["floor", "c"] == pytest.approx(0.02) and found["a", "b"] == pytest.approx(-0.01)
    assert floating(scene) == ["c"]
    assert floating(scene, tolerance=0.0005) == ["c", "d"]
    assert [(a, b) for a, b, _ in intersecting(scene)] == [("a", "b")]
    assert intersecting(scene)[0][2] == pytest.approx(0.01)
    assert floating(matter(cube("a", 0, 0.05))) == ["a"]
    # Two that touch each other and nothing else float together.
    assert floating(matter(FLOOR, cube("a", 0, 0.25), cube("b", 0, 0.35))) == ["a", "b"]
    assert floating(matter(FLOOR, gravity=GRAVITY)) == []


def test_block_towers_by_balance_alone():
    towers = real_towers()
    right = sum(
        can_stand(scene) == tower["stable"] for scene, tower in zip(towers_as_matter(towers), towers, strict=True)
    )
    print(f"{right} of {len(towers)} towers right")
    assert right >= 197
