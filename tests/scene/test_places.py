"""Places: seeds take turns among those of their part, and no recording is in two parts."""

import pytest

from tests.scene.traffic.recordings import street, write
from warpav.core.errors import InputError
from warpav.scene import TownSource, ego_vehicle, parts_of, sources_of
from warpav.scene.traffic.traffic_scene import TrafficSource


@pytest.fixture
def mine(tmp_path):
    write(tmp_path, street(), "one.json")
    return str(tmp_path)


def test_seeds_take_turns_among_places(mine):
    sources = sources_of(["town:dense", mine], range(5), ego_vehicle().bounds_m())
    assert [type(source) for source in sources] == [TownSource, TrafficSource] * 2 + [TownSource]
    assert [source.seed for source in sources] == [0, 1, 2, 3, 4]
    assert sources[0].level == "dense"
    assert sources[1].moment != sources[3].moment
    # whatever other scenes are asked for
    assert sources_of(["town:dense", mine], [3], ego_vehicle().bounds_m()) == sources[3:4]


def test_parts_have_places_of_their_own(mine):
    assert parts_of(["sind", mine], None, None) == (("sind",), ("sind",), (mine,))
    assert parts_of(["sind"], ["town:easy"], [mine]) == (("sind",), ("town:easy",), (mine,))
    for selection in (None, ["sind", mine]):
        with pytest.raises(InputError, match=r"one.json: expected a recording for the test alone, got the content of"):
            parts_of(["sind", mine] if selection is None else ["sind"], selection, ["town:easy", mine])


def test_what_is_no_place_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"expected town:easy, .*, sind, or the path of .*; did you mean town:dense\?"):
        parts_of(["town:dens"], None, ["town:easy"])
    with pytest.raises(InputError, match=r"expected recorded traffic .*, got a folder without any"):
        parts_of([str(tmp_path)], None, ["town:easy"])
