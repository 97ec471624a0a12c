"""Small recordings, written by hand: a straight street, with cars that drive along it."""

import gzip
import json
import math

import numpy as np

from warpav.scene.traffic import recording

LANE_M = 3.5
STEP_S = 0.5


def track(user_id, category, size_m, start_m, yaw_rad, speed_m_s, *, steps=9, step_s=STEP_S, first=0):
    """Somebody who drives straight on, as the JSON format has it."""
    t = np.arange(first, first + steps)
    way = speed_m_s * step_s * (t - first)
    user = {
        "id": user_id,
        "type": category,
        "length_m": size_m[0],
        "width_m": size_m[1],
        "t": t.tolist(),
        "x_m": (start_m[0] + way * math.cos(yaw_rad)).tolist(),
        "y_m": (start_m[1] + way * math.sin(yaw_rad)).tolist(),
        "yaw_rad": [yaw_rad] * steps,
        "v_mps": [speed_m_s] * steps,
    }
    return user if len(size_m) == 2 else {**user, "height_m": size_m[2]}


def street(*, turn_rad=0.0, shift_m=(0.0, 0.0), users=None, **changes):
    """A street along x of two lanes, one in either direction, turned about the origin and shifted, as JSON data."""
    if users is None:
        users = [
            track("a", "car", (4.5, 1.8), (-10.0, -1.75), 0.0, 8.0),
            track("b", "car", (4.2, 1.75, 1.5), (8.0, -1.75), 0.0, 6.0),
            track("c", "truck", (8.0, 2.4), (60.0, 1.75), math.pi, 10.0),
            track("d", "bicycle", (1.8, 0.6), (-30.0, -3.0), 0.0, 4.0),
            track("e", "pedestrian", (0.7, 0.7), (5.0, 5.5), 0.0, 1.0),
        ]
    c, s = math.cos(turn_rad), math.sin(turn_rad)

    def moved(x, y):
        return [c * x - s * y + shift_m[0], s * x + c * y + shift_m[1]]

    placed = []
    for user in users:
        place = [moved(x, y) for x, y in zip(user["x_m"], user["y_m"], strict=True)]
        yaw = [yaw + turn_rad for yaw in user["yaw_rad"]]
        placed.append({**user, "x_m": [x for x, _ in place], "y_m": [y for _, y in place], "yaw_rad": yaw})
    x = (-90.0, 0.0, 90.0)
    lanelets = [
        {"left": [moved(each, 0.0) for each in x], "right": [moved(each, -LANE_M) for each in x], "type": ["urban"]},
        {
            "left": [moved(each, 0.0) for each in x[::-1]],
            "right": [moved(each, LANE_M) for each in x[::-1]],
            "type": [],
        },
    ]
    data = {"id": "street", "source": "by hand", "dt_s": STEP_S, "lanelets": lanelets, "road_users": placed}
    return {**data, **changes}


def write(folder, data, name="street.json"):
    """The file of a recording."""
    file = folder / name
    content = json.dumps(data).encode()
    file.write_bytes(gzip.compress(content) if name.endswith(".gz") else content)
    return file


def recording_of(data):
    """The recording of JSON data, without a file."""
    users = tuple(
        recording.RecordedUser(
            user["id"],
            user["type"],
            (user["length_m"], user["width_m"], user.get("height_m", math.nan)),
            np.array(user["t"]),
            np.stack([user["x_m"], user["y_m"], user["yaw_rad"]], axis=1),
            None if "v_mps" not in user else np.array(user["v_mps"], float),
        )
        for user in data["road_users"]
    )
    lanelets = tuple(recording.Lanelet(np.array(each["left"]), np.array(each["right"])) for each in data["lanelets"])
    return recording.recording_of(data["id"], data["source"], data["dt_s"], lanelets, users, data.get("ego"))
