"""Simulated and drone recordings: SUMO, INTERACTION, inD and highD, against small samples written by hand."""

import gzip
import math

import numpy as np
import pytest

from warpav.core.errors import InputError
from warpav.scene.traffic.files import read_recording, recordings_in
from warpav.scene.traffic.formats._lanelet2 import utm_m

NET = """<?xml version="1.0"?>
<!-- made by <netconvert/> --><net>
  <edge function="internal"><lane id=":J_0_0" shape="100.00,0.00 100.00,0.00 120.00,0.00,1.5"/></edge>
  <edge function="crossing"><lane id=":J_c0_0" allow="pedestrian" width="4.00" shape="98.0,-5.0 98.0,5.0"/></edge>
  <edge function="walkingarea"><lane id=":J_w0_0" allow="pedestrian" shape="90.0,8.0 95.0,8.0"/></edge>
  <edge id="E0"><lane id="E0_0" allow="pedestrian" shape="0.00,-4.00 100.00,-4.00"/>
    <lane id="E0_1" disallow="pedestrian" shape="0.00,0.00 100.00,0.00"/></edge></net>"""
TYPES = """<routes><vType id="lorry" vClass="truck" length="8.40" width="2.30" height="3.10"/><vTypeDistribution>
  <vType id="estate" length="4.60" guiShape="passenger/wagon"/></vTypeDistribution></routes>"""
VEHICLE = '<vehicle id="{}" x="{:.2f}" y="{:.2f}" angle="{:.2f}" type="{}" speed="{:.2f}" pos="5" lane="E0_1"/>'
TRACKS, ABOUT, CLASSES = "vehicle_tracks_000.csv", "07_recordingMeta.csv", "07_tracksMeta.csv"


def fcd():
    """An estate car along x, a lorry along y, a bus along x with somebody in it, a tram, and a walker."""
    text = '<?xml version="1.0"?>\n<!-- <net-file value="other.net.xml"/> -->\n<fcd-export>\n'
    for k in range(21):
        text += f'<timestep time="{100 + 0.1 * k:.2f}">' + VEHICLE.format("0", 10 + k, 0, 90, "estate@0", 10)
        text += VEHICLE.format("1", 30, k, 0, "lorry", 10) + VEHICLE.format("t", 40, 9, 90, "tram", 0)
        bus = VEHICLE.format("2", 40 + k, 0, 90, "bus_bus", 10)
        text += bus.replace("/>", f'><person id="in" x="{40 + k}" y="0" angle="90" speed="10"/></vehicle>')
        text += f'<person id="0" x="98" y="{-5 + 0.1 * k:.2f}" angle="0" type="DEFAULT_PEDTYPE" speed="1"/></timestep>'
    return text + "</fcd-export>\n"


def write_sumo(folder, **files):
    for name, content in {"fcd": fcd(), "road.net": NET, "all.rou": TYPES, "tripinfo": "<tripinfos/>", **files}.items():
        (folder / f"{name}.xml").write_text(content)
    return folder


def read_only(folder):
    [file] = recordings_in([folder])
    return file, read_recording(file)


def test_sumo_is_read_with_its_net_and_types(tmp_path):
    file, recording = read_only(write_sumo(tmp_path))
    assert (file.name, recording.step_s) == ("fcd.xml", pytest.approx(0.1))
    estate, lorry, bus, walker = recording.users
    assert (estate.category, estate.size_m, estate.step.tolist()) == ("car", (4.6, 1.8, 1.5), list(range(21)))
    assert estate.pose[3] == pytest.approx([13.0 - 2.3, 0.0, 0.0])  # the middle of its front bumper was told
    assert estate.speed_m_s == pytest.approx(np.full(21, 10.0))
    assert lorry.pose[3] == pytest.approx([30.0, 3.0 - 4.2, 0.5 * math.pi])
    assert (lorry.size_m, bus.size_m, walker.category) == ((8.4, 2.3, 3.1), (12.0, 2.5, 3.4), "pedestrian")
    inside, crossing, lane = recording.lanelets
    assert (inside.kinds, crossing.is_crosswalk) == (("intersection",), True)
    assert crossing.left_m == pytest.approx(np.array([[96.0, -5.0], [96.0, 5.0]]))
    assert lane.left_m == pytest.approx(np.array([[0.0, 1.6], [100.0, 1.6]]))
    assert recording.account.endswith("(tram 1); SUMO's default sizes without a vType of DEFAULT_PEDTYPE, bus_bus")


def test_sumo_may_be_packed_and_alone_and_a_bad_vehicle_costs_itself(tmp_path):
    twice = VEHICLE.format("1", 30, 5, 0, "lorry", 10)
    (tmp_path / "packed.xml.gz").write_bytes(gzip.compress(fcd().replace(twice, 2 * twice).encode()))
    _, recording = read_only(tmp_path)
    assert [user.user_id for user in recording.users] == ["0", "2", "person 0"]
    assert recording.users[0].size_m == (5.0, 1.8, 1.5)
    assert "road user 1: t: expected ascending steps" in recording.account
    assert "without lanes, the road follows the tracks" in recording.account


def test_of_several_nets_the_named_one_is_taken(tmp_path):
    file = write_sumo(tmp_path, **{"other.net": NET.replace("120.00", "140.00")}) / "fcd.xml"
    assert read_recording(file).lanelets[0].left_m[-1, 0] == 140.0
    write_sumo(tmp_path, **{"other.net": NET})  # which is read again
    assert read_recording(file).lanelets[0].left_m[-1, 0] == 120.0
    write_sumo(tmp_path, fcd=fcd().replace("other.net", "third.net"))
    with pytest.raises(InputError, match=r"net: expected the one .* other.net.xml and road.net.xml; leave one"):
        read_recording(file)


def local(x, y):
    return f'lat="0" lon="0"><tag k="local_x" v="{x}"/><tag k="local_y" v="{y}"/></node>'


def osm(place_of):
    """Two lanes along y, told upside down, a crossing, a path and half a lane."""
    points = [(0, 0), (0, 50), (3, 0), (3, 50), (6, 0), (6, 50), (-2, 20), (8, 20), (-2, 24), (8, 24)]
    text = "".join(f'<node id="{k}" {place_of(x, y)}' for k, (x, y) in enumerate(points))
    ways = [(1, 0, "road_border"), (2, 3, "line_thin"), (4, 5, "virtual"), (6, 7, "zebra"), (8, 9, "zebra")]
    for k, (a, b, kind) in enumerate(ways):
        text += f'<way id="{k}"><nd ref="{a}"/><nd ref="{b}"/><tag k="type" v="{kind}"/></way>'
    for a, b, kind in [(0, 1, "road"), (1, 2, "road"), (3, 4, "crosswalk"), (3, 4, "walkway"), (3, 77, "road")]:
        text += f'<relation><member ref="{a}" role="left"/><member ref="{b}" role="right"/>'
        text += f'<tag k="type" v="lanelet"/><tag k="subtype" v="{kind}"/></relation>'
    return f"<osm>{text}</osm>"


def write_interaction(folder, place_of=local):
    """A car along y, a walker who stands first and a cyclist."""
    tracks = folder / "recorded_trackfiles" / "DR_Place"
    tracks.mkdir(parents=True, exist_ok=True)
    (folder / "maps").mkdir(exist_ok=True)
    (folder / "maps" / "DR_Place.osm").write_text(osm(place_of))
    (folder / "maps" / "DR_Other.osm").write_text("no map")
    head, who, steps = "track_id,frame_id,timestamp_ms,agent_type,x,y,vx,vy", "pedestrian/bicycle", range(1, 41)
    rows = [f"1,{k},{100 * k},car,1.5,{k},0,10,1.5708,4.5,1.8" for k in steps]
    (tracks / TRACKS).write_text("\n".join([f"{head},psi_rad,length,width", *rows, ""]))
    rows = [f"P1,{k},{100 * k},{who},8,{22 - 0.1 * max(k - 10, 0)},0,{-1 if k > 10 else 0}" for k in steps]
    rows += [f"P2,{k},{100 * k},{who},{0.5 * k},30,5,0" for k in steps]
    (tracks / "pedestrian_tracks_000.csv").write_text("\n".join([head, *rows, ""]))
    return folder


def test_interaction_is_read_with_people_and_map(tmp_path):
    _, recording = read_only(write_interaction(tmp_path))
    assert (recording.recording_id, recording.step_s) == ("DR_Place 000", pytest.approx(0.1))
    car, walker, cyclist = recording.users
    assert (car.user_id, car.category, car.size_m[:2]) == ("1", "car", (4.5, 1.8))
    assert car.pose[2] == pytest.approx([1.5, 3.0, 1.5708])
    assert car.speed_m_s == pytest.approx(np.full(40, 10.0))
    assert (walker.user_id, walker.category, cyclist.category) == ("person P1", "pedestrian", "bicycle")
    assert walker.pose[[0, -1], 2] == pytest.approx([-0.5 * math.pi] * 2)
    assert cyclist.size_m[:2] == (1.8, 0.6)
    lane, inside, crossing = recording.lanelets
    assert np.c_[lane.left_m, lane.right_m].tolist() == [[0.0, 0.0, 3.0, 0.0], [0.0, 50.0, 3.0, 50.0]]
    assert (lane.kinds, inside.kinds, crossing.is_crosswalk) == ((), ("intersection",), True)


def test_maps_are_projected_and_may_be_missing_or_elsewhere(tmp_path):
    assert utm_m(np.array(45.0), np.array(3.0), 3.0) == pytest.approx([500_000.0, 4_982_950.400], abs=0.01)
    write_interaction(tmp_path, place_of=lambda x, y: f'lat="{y / 110_574.3}" lon="{x / 111_319.5}"/>')
    file, recording = read_only(tmp_path)
    assert recording.lanelets[0].right_m == pytest.approx(np.array([[3.0, 0.0], [3.0, 50.0]]), abs=0.06)  # 0.1 % larger
    write_interaction(tmp_path, place_of=lambda x, y: local(x + 4000, y))
    assert "DR_Place.osm: lanelets: expected the lanes" in read_recording(file).account
    (tmp_path / "maps" / "DR_Place.osm").unlink()
    assert read_recording(file).account == "without lanes, the road follows the tracks"


def write_ind(folder):
    """A parked car, a van along x, a walker along y without a size, and a dog."""
    rows = ["recordingId,trackId,frame,trackLifetime,xCenter,yCenter,heading,width,length,xVelocity,yVelocity"]
    for k in range(3, 64):
        rows += [f"7,0,{k},{k},20.0,-5.0,90.0,1.8,4.4,0.0,0.0", f"7,1,{k},{k},{0.4 * k},0.0,360.0,2.0,5.2,10.0,0.0"]
        rows += [f"7,2,{k},{k},5.0,{0.04 * k},0.0,0.0,0.0,0.0,1.0", f"7,3,{k},{k},5.0,9.0,0.0,0.3,0.8,0.0,0.0"]
    data, place = folder / "data", folder / "maps" / "lanelets" / "01_place"
    data.mkdir()
    place.mkdir(parents=True)
    (data / "07_tracks.csv").write_text("\n".join([*rows, ""]))
    (data / CLASSES).write_text("recordingId,trackId,class\n7,0,car\n7,1,van\n7,2,pedestrian\n7,3,animal\n")
    (data / ABOUT).write_text("locationId,frameRate,xUtmOrigin,yUtmOrigin\n1,25.0,297000.0,5629000.0\n")
    (place / "location1.osm").write_text(osm(local))
    (place / "location1_construction.osm").write_text("no map")
    return folder


def test_ind_is_read(tmp_path):
    file, recording = read_only(write_ind(tmp_path))
    assert recording.step_s == pytest.approx(0.2)  # every fifth frame
    parked, van, walker = recording.users
    assert (van.category, van.size_m[:2], van.step.tolist()) == ("car", (5.2, 2.0), list(range(12)))
    assert van.pose[0] == pytest.approx([2.0, 0.0, 2.0 * math.pi])
    assert parked.pose[-1] == pytest.approx([20.0, -5.0, 0.5 * math.pi])
    assert walker.pose[:, 2] == pytest.approx(np.full(12, 0.5 * math.pi))
    assert (walker.size_m[:2], walker.speed_m_s.tolist()) == ((0.5, 0.6), pytest.approx([1.0] * 12))
    assert len(recording.lanelets) == 3
    assert recording.account == "1 objects passed over that are no road users (animal 1)"
    x, y = utm_m(np.array(50.78), np.array(6.12), 9.0).tolist()  # a map by latitude is moved to this origin
    file.with_name(ABOUT).write_text(f"locationId,frameRate,xUtmOrigin,yUtmOrigin\n1,25.0,{x},{y}\n")
    [other] = tmp_path.rglob("location1.osm")
    other.write_text(osm(lambda x, y: f'lat="{50.78 + y / 111_250}" lon="{6.12 + x / 70_530}"/>'))
    border = read_recording(file).lanelets[0].left_m
    assert np.linalg.norm(border, axis=1) == pytest.approx([0.0, 50.0], abs=0.1)


def write_highd(folder):
    """A car to the right and a lorry to the left, by the upper left corners of their boxes."""
    rows = [f"{k},1,{k},20.1,4.5,1.8,25.0,0.0\n{k},2,{300 - 0.8 * k},9.0,12.0,2.5,-20.0,0.0" for k in range(1, 41)]
    (folder / "01_tracks.csv").write_text("\n".join(["frame,id,x,y,width,height,xVelocity,yVelocity", *rows, ""]))
    (folder / "01_tracksMeta.csv").write_text("id,class,drivingDirection\n1,Car,2\n2,Truck,1\n")
    about = "frameRate,upperLaneMarkings,lowerLaneMarkings\n25,8.0;12.0;16.0,19.0;23.0\n"
    (folder / "01_recordingMeta.csv").write_text(about)
    return folder


def test_highd_is_mirrored(tmp_path):
    _, recording = read_only(write_highd(tmp_path))
    car, lorry = recording.users
    assert (car.category, car.size_m[:2], lorry.category) == ("car", (4.5, 1.8), "truck")
    assert car.pose[0] == pytest.approx([5.0 + 2.25, -21.0, 0.0])
    assert lorry.pose[0] == pytest.approx([296.0 + 6.0, -10.25, math.pi])
    assert (car.speed_m_s.tolist(), lorry.speed_m_s.tolist()) == ([25.0] * 8, [20.0] * 8)
    outer, inner, lower = recording.lanelets
    assert lower.left_m.tolist() == [[-30.0, -19.0], [332.0, -19.0]]
    assert outer.right_m[:, 1].tolist() == [-8.0, -8.0]  # it leads to the left, so its right border is outside
    assert (outer.left_m[0, 0] > outer.left_m[1, 0], inner.left_m[0, 1]) == (True, -16.0)


SAMPLES = {"SUMO": write_sumo, "INTERACTION": write_interaction, "inD": write_ind, "highD": write_highd}


@pytest.mark.parametrize(
    ("write", "name", "old", "new", "message"),
    [
        (write_sumo, "fcd.xml", " angle=", " heading=", r"fcd.xml: x, y and angle: expected all of every vehicle"),
        (write_sumo, "fcd.xml", "</fcd-export>", "", r"fcd.xml: .*expected whole FCD output, got a syntax error"),
        (write_sumo, "fcd.xml", 'time="', 'time="0:', r"time of timesteps in seconds: expected a finite time"),
        (write_sumo, "fcd.xml", 'speed="10.00"', 'speed="36.00"', r"v_mps: .*; km/h, or another dt_s"),
        (write_sumo, "fcd.xml", 'y="', 'y="9', r"lanelets: expected the lanes that the road users drive on"),
        (write_sumo, "fcd.xml", 'time="102.00"', 'time="1e12"', r"t: expected steps from 0 to 1000000"),
        (write_sumo, "fcd.xml", "<fcd-export>", "<!DOCTYPE a><fcd-export>", r"expected XML without a DOCTYPE"),
        (write_sumo, "fcd.xml", "<fcd-export>", "<fcd-export>" + "<a/>" * 5000, r"at most 5,000 values"),
        (write_sumo, "road.net.xml", "98.0,-5.0", "98.0", r"road.net.xml: lane :J_c0_0: shape: expected points as x,y"),
        (write_interaction, TRACKS, ",width", ",wide", r"000.csv: expected a column width, got track_id, "),
        (write_interaction, TRACKS, "08,4.5,1.8\n1,9", "0\n1,9", r"000.csv:9: expected 11 columns .*, got 9; is it"),
        (write_interaction, TRACKS, "1.5708", "90.0", r"yaw_rad: "),
        (write_interaction, TRACKS, ",4.5,1.8", ",450,180", r"road user 1: length_m: .*must be in metres"),
        (write_interaction, TRACKS, "1.5708", "north", r"000.csv:2: psi_rad: expected a number, got 'north'"),
        (write_interaction, TRACKS, "car,1.5", "car,nan", r"road user 1: expected finite positions"),
        (write_interaction, TRACKS, "1,2,200,", "1,2,100,", r"road user 1: t: expected ascending steps"),
        (write_interaction, TRACKS, "car", "x" * 2_000_000, r"got a line of more than 1,000,000 characters"),
        (write_interaction, "DR_Place.osm", "</osm>", "", r"DR_Place.osm:1: expected a lanelet2 map, got a syntax"),
        (write_interaction, TRACKS, "1,9,900,", ",,,,,,,,,,\n" * 600 + "1,9,900,", r"at most 5,000 values"),
        (write_ind, ABOUT, "25.0", "0", r"recordingMeta.csv: frameRate: expected frames a second, got 0"),
        (write_ind, CLASSES, "7,1,van", "7,0,van", r"tracksMeta.csv: trackId: expected every id once, got 0 twice"),
        (write_ind, CLASSES, "7,", "7,9", r"user 0: class: expected a row with its trackId in 07_tracksMeta.csv, got"),
        (write_highd, "01_recordingMeta.csv", "8.0;", "8.0|", r"upperLaneMarkings: expected y separated by ;, got"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path, monkeypatch, write, name, old, new, message):
    for module in ("_rows", "_sumo"):
        monkeypatch.setattr(f"warpav.scene.traffic.formats.{module}.STREAM_NODES_MAX", 5000)
    [file] = recordings_in([write(tmp_path)])
    [part] = tmp_path.rglob(name)
    assert old in part.read_text()
    part.write_text(part.read_text().replace(old, new))
    for people in tmp_path.rglob("pedestrian_tracks*"):
        people.unlink()
    with pytest.raises(InputError, match=message) as error:
        read_recording(file)
    assert "\n" not in str(error.value)
