"""States, edits, stages, plan and cameras."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from chronoscene.errors import ConfigError
from chronoscene.synth import preset
from chronoscene.synth.city.plan import make_world
from chronoscene.synth.city.world import SITE, World, renewal_stages, site_stages, tree_heights
from chronoscene.synth.generation import make_periods
from chronoscene.synth.render.light import make_lights
from chronoscene.synth.render.mesh import Mesh, MeshBuilder


def cube(size: float) -> Mesh:
    b = MeshBuilder()
    b.boxes([0.0, 0, 0], [size, 0, 0], [0, size, 0], [0, 0, size], b.style(0, (1.0, 1.0, 1.0)))
    return b.build()


def test_states_become_lifetimes_and_edits() -> None:
    world = World(0, make_lights(0, 4), np.zeros((2, 2)))
    world.add("house", "building", [None, 1.0, 1.0, 2.0], cube)
    world.place("car", "car", [True, True, False, True], lambda: cube(3.0))
    assert [(e.name, e.state, e.periods) for e in world.elements] == [
        ("house", "1.0", (1, 2)),
        ("house", "2.0", (3,)),
        ("car", "there", (0, 1, 3)),
    ]
    assert [(e.period, e.action, e.target) for e in world.edits] == [
        (1, "add", "house"),
        (3, "rebuild", "house"),
        (2, "remove", "car"),
        (3, "add", "car"),
    ]
    assert world.edits[1].bounds == ((0.0, 0.0, 0.0), (2.0, 2.0, 2.0))
    mesh, ids = world.geometry(3)
    assert len(mesh.tri_patch) == len(ids) == 24
    assert sorted(set(ids)) == [0, 1]


@given(st.integers(1, 50))
def test_a_site_grows_and_a_house_falls(periods: int) -> None:
    site, house = site_stages(periods), renewal_stages(periods)
    assert len(site) == len(house) == periods
    order = [SITE.index(s) for s in site]
    assert order == sorted(order) and site[-1] == "finished"
    assert house[0] == "house"
    if periods > 1:
        assert site[0] == "lot" and house[-1] == "park"


@given(st.integers(0, 10_000), st.integers(1, 50))
def test_trees_grow(seed: int, periods: int) -> None:
    heights = tree_heights(np.random.default_rng(seed), periods, 6.0)
    there = [h for h in heights if h is not None]
    assert len(heights) == periods and there and there == sorted(there)
    assert max(there) < 6.0 * 3.5


@settings(max_examples=25)
@given(st.integers(0, 2**31 - 1), st.integers(1, 50))
def test_lights_and_dates_are_all_different(seed: int, periods: int) -> None:
    lights = make_lights(seed, periods)
    dates = [p.date for p in make_periods(World(seed, lights, np.zeros((2, 2))))]
    assert dates == sorted(set(dates))
    for a, b in pairwise(lights):
        assert a.name != b.name
        assert np.linalg.norm(a.direction - b.direction) > 0.15
    assert all(5 < light.elevation < 75 for light in lights)


@pytest.mark.slow
def test_the_light_can_stay() -> None:
    world = make_world(preset("tiny", periods=4, same_light=True))
    assert world.lights == make_lights(0, 1) * 4
    assert len({p.date for p in make_periods(world)}) == 4
    assert world.edits


@pytest.mark.parametrize(
    ("change", "option"),
    [
        ({"periods": 0}, "--periods"),
        ({"width": 3}, "--size"),
        ({"seed": -1}, "--seed"),
        ({"kind": "submarine"}, "--kind"),
        ({"noise": float("nan")}, "--noise"),
    ],
)
def test_settings_out_of_range(change: dict, option: str) -> None:
    with pytest.raises(ConfigError, match=option):
        preset("tiny", **change)


def test_unknown_preset() -> None:
    with pytest.raises(ConfigError, match="did you mean 'demo'"):
        preset("demmo")


@pytest.mark.slow
def test_cameras_keep_their_distance(made, renderers) -> None:  # type: ignore[no-untyped-def]
    """In no period is a camera inside of an object or right before one."""
    for frame in made.scene.frames:
        eye = np.linalg.inv(frame.cam_from_world)[:3, 3]
        for renderer in renderers:
            assert renderer.surfaces.nearest(eye[None])[0] >= 3.5
            depth = renderer.maps(frame.camera, frame.cam_from_world).depth
            assert depth[depth > 0].min() > 4.0


@pytest.mark.slow
def test_street_views_walk_between_the_houses() -> None:
    from chronoscene.synth.city.plan import make_world
    from chronoscene.synth.flights import plan_frames
    from chronoscene.synth.generation import make_renderers

    wanted = preset("tiny", kind="street", views=6)
    world = make_world(wanted)
    renderers = make_renderers(wanted, world)
    views = plan_frames(wanted, world, renderers)
    eyes = np.array([np.linalg.inv(v.cam_from_world)[:3, 3] for v in views])
    assert (eyes[:, 2] > 1.2).all() and (eyes[:, 2] < 4.5).all()
    forward = np.array([v.cam_from_world[2, :3] for v in views])
    assert (np.abs(forward[:, 2]) < 0.35).all(), "street cameras look along the ground"
    # No facade may be closer than the walk allows, in any period.
    for renderer in renderers:
        assert (renderer.surfaces.nearest(eyes)[0] > 0.7).all()


@pytest.mark.slow
def test_rebuilt_blocks_leave_the_streets() -> None:
    plain = make_world(preset("tiny"))
    city = make_world(preset("tiny", rebuilt=1.0))
    first = {e.name for e in plain.elements if 0 in e.periods}
    assert {e.name for e in city.elements if 0 in e.periods} == first
    kept = [e for e in city.elements if e.periods == (0, 1)]
    assert any(e.kind == "ground" for e in kept)
    assert not any(e.kind == "building" and e.name.startswith("block") for e in kept)
    new = {e.name for e in city.elements if e.periods == (1,)}
    assert {name.split("/")[0] for name in new if "rebuilt" in name} == {
        f"block_{i}{j}_rebuilt" for i in range(4) for j in range(4)
    }


def test_part_of_the_blocks_is_rebuilt() -> None:
    city = make_world(preset("tiny", rebuilt=0.4, seed=3))
    rebuilt = {e.name.split("/")[0] for e in city.elements if "rebuilt" in e.name}
    assert 2 <= len(rebuilt) <= 12
