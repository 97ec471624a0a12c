"""One camera in the conventions of every format, and samples of files as a user would have them.

The camera lies 1.7 m ahead, 0.5 m left and 1.6 m up, rolled by 2, nose 5 down, 45 to the left [deg]. Its quaternion and
matrix were computed with scipy, CARLA's signs with the transform class of its 0.9.16 wheel.
"""

import json
import math
from pathlib import Path

import numpy as np

POSITION_M = (1.7, 0.5, 1.6)
YAW_DEG, PITCH_DEG, ROLL_DEG = 45.0, 5.0, 2.0
QUATERNION_WXYZ = (0.628581, -0.676128, 0.293989, -0.247605)
CAMERA_FROM_EGO = np.array(
    [
        [0.704525, -0.708827, -0.034767, -0.787653],
        [-0.086269, -0.036913, -0.995588, 1.758054],
        [0.704416, 0.704416, -0.087156, -1.410266],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
# fx = fy = 320 and the principal point in the centre of 640 x 480, counted from the centre of the first pixel
MATRIX = [[320.0, 0.0, 319.5], [0.0, 320.0, 239.5], [0.0, 0.0, 1.0]]
ROLL_RAD, PITCH_RAD, YAW_RAD = (math.radians(angle) for angle in (ROLL_DEG, PITCH_DEG, YAW_DEG))

CAMERA_INFO = """\
image_width: 640
image_height: 480
camera_name: front_left
camera_matrix:
  rows: 3
  cols: 3
  data: [320., 0., 319.5, 0., 320., 239.5, 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0, 0, 0, 0, 0]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [320, 0, 319.5, 0, 0, 320, 239.5, 0, 0, 0, 1, 0]}
"""

URDF = f"""\
<?xml version="1.0"?>
<robot name="shuttle">
  <link name="base_footprint"/>
  <link name="base_link"/>
  <link name="roof"/>
  <link name="lidar_link"/>
  <link name="front_left/camera_link"/>
  <link name="front_left/camera_optical_link"/>
  <joint name="up" type="fixed">
    <parent link="base_footprint"/><child link="base_link"/><origin xyz="0.1 0 0.3"/>
  </joint>
  <joint name="roof_joint" type="fixed">
    <parent link="base_link"/><child link="roof"/><origin xyz="1.0 0.0 1.5"/>
  </joint>
  <joint name="lidar_joint" type="fixed"><parent link="roof"/><child link="lidar_link"/></joint>
  <joint name="camera_joint" type="fixed">
    <parent link="roof"/><child link="front_left/camera_link"/>
    <origin xyz="0.7 0.5 0.1" rpy="{ROLL_RAD} {PITCH_RAD} {YAW_RAD}"/>
  </joint>
  <joint name="optical_joint" type="fixed">
    <parent link="front_left/camera_link"/><child link="front_left/camera_optical_link"/>
    <origin rpy="-1.5707963267948966 0 -1.5707963267948966"/>
  </joint>
</robot>
"""

# the kit is turned by a quarter, so that a forgotten or swapped step of the chain shows
AUTOWARE_SENSORS = f"""\
base_link:
  sensor_kit_base_link: {{x: 1.0, y: 0.2, z: 1.5, roll: 0.0, pitch: 0.0, yaw: {math.pi / 2}}}
  velodyne_rear_base_link: {{x: -0.3, y: 0.0, z: 1.3, roll: 0.0, pitch: 0.0, yaw: 3.14}}
"""
AUTOWARE_KIT = f"""\
sensor_kit_base_link:
  front_left/camera_link:
    x: 0.3
    y: -0.7
    z: 0.1
    roll: {ROLL_RAD}
    pitch: {PITCH_RAD}
    yaw: {YAW_RAD - math.pi / 2}
  velodyne_top_base_link: {{x: 0.0, y: 0.0, z: 0.3, roll: 0.0, pitch: 0.0, yaw: 1.575}}
"""

BRIDGE = {
    "objects": [
        {"type": "sensor.pseudo.traffic_lights", "id": "traffic_lights"},
        {
            "type": "vehicle.tesla.model3",
            "id": "ego_vehicle",
            "sensors": [
                {"type": "sensor.lidar.ray_cast", "id": "lidar", "spawn_point": {"x": 0.0, "y": 0.0, "z": 2.4}},
                {
                    "type": "sensor.camera.rgb",
                    "id": "front_left",
                    "spawn_point": {"x": 1.7, "y": 0.5, "z": 1.6, "roll": 2.0, "pitch": 5.0, "yaw": 45.0},
                    "image_size_x": 640,
                    "image_size_y": 480,
                    "fov": 90.0,
                },
            ],
        },
    ]
}

PYTHON_SENSORS = """\
[
    {'type': 'sensor.camera.rgb', 'x': 1.7, 'y': -0.5, 'z': 1.60, 'roll': 2.0, 'pitch': -5.0, 'yaw': -45.0,
     'width': 640, 'height': 480, 'fov': 90, 'id': 'front_left'},
    {'type': 'sensor.other.gnss', 'x': 0.7, 'y': -0.4, 'z': 1.60, 'id': 'GPS'},
]
"""

SENSOR_TOKEN, CALIBRATION_TOKEN = "725903f5b62f56118f4094b46a4470d8", "f4d2a6c281f34a7eb8bb033d82321f79"
NUSCENES = {
    "calibrated_sensor.json": [
        {
            "token": "lidar0",
            "sensor_token": "lidar",
            "translation": [0.9, 0.0, 1.8],
            "rotation": [0.707, -0.006, 0.011, -0.707],
            "camera_intrinsic": [],
        },
        {
            "token": CALIBRATION_TOKEN,
            "sensor_token": SENSOR_TOKEN,
            "translation": list(POSITION_M),
            "rotation": list(QUATERNION_WXYZ),
            "camera_intrinsic": MATRIX,
        },
    ],
    "sensor.json": [
        {"token": SENSOR_TOKEN, "channel": "front_left", "modality": "camera"},
        {"token": "lidar", "channel": "LIDAR_TOP", "modality": "lidar"},
    ],
    "sample_data.json": [
        {
            "token": "d",
            "sample_token": "s",
            "calibrated_sensor_token": CALIBRATION_TOKEN,
            "width": 640,
            "height": 480,
        }
    ],
}

# KITTI's own layout: P1 sits half a metre to the right of P0 in the image
KITTI = "\n".join(
    [
        "P0: 320 0 319.5 0 0 320 239.5 0 0 0 1 0",
        "P1: 320 0 319.5 -160 0 320 239.5 0 0 0 1 0",
        "P2: 320 0 319.5 0 0 320 239.5 0 0 0 1 0",
        "P3: 320 0 319.5 -160 0 320 239.5 0 0 0 1 0",
        "R0_rect: 1 0 0 0 1 0 0 0 1",
        "Tr_velo_to_cam: " + " ".join(str(value) for value in CAMERA_FROM_EGO[:3].flat),
        "Tr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0",
        "",
    ]
)

OPENCV = f"""\
%YAML:1.0
---
calibration_time: "Thu 21 Nov 2024"
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 320., 0., 319.5, 0., 320., 239.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 0., 0., 0., 0., 0. ]
R: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ {", ".join(str(value) for value in CAMERA_FROM_EGO[:3, :3].flat)} ]
T: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ {", ".join(str(value) for value in CAMERA_FROM_EGO[:3, 3])} ]
"""

# cam1 is cam0 moved by 0.2 m to the right: x_cam1 = x_cam0 - (0.2, 0, 0)
KALIBR = f"""\
cam0:
  T_cam_imu:
{chr(10).join(f"  - {row.tolist()}" for row in CAMERA_FROM_EGO)}
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]
  distortion_model: radtan
  intrinsics: [320.0, 321.0, 319.5, 239.5]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.2]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.013, 0.0021, -0.0042, 0.0007]
  distortion_model: equidistant
  intrinsics: [320.0, 320.0, 319.5, 239.5]
  resolution: [640, 480]
  rostopic: /cam1/image_raw
"""

# principal points count from the image's corner here, and "rig_to_camera" is the camera's pose in the vehicle
W, X, Y, Z = QUATERNION_WXYZ
ALPASIM = f"""\
# @package _global_
runtime:
  simulation_config:
    cameras:
    - {{logical_id: front_left, height: 320, width: 512, frame_interval_us: 100_000, shutter_duration_us: 30_000}}
  extra_cameras:
  - logical_id: front_left
    rig_to_camera:
      translation_m: {list(POSITION_M)}
      rotation_xyzw: [{X}, {Y}, {Z}, {W}]
    intrinsics:
      model: opencv_pinhole
      opencv_pinhole:
        focal_length: [320.0, 320.0]
        principal_point: [320.0, 240.0]
        radial: [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
        tangential: [0.0, 0.0]
        thin_prism: [0.0, 0.0, 0.0, 0.0]
    resolution_hw: [480, 640]
    shutter_type: ROLLING_TOP_TO_BOTTOM
"""

DRIVEWORKS = {
    "rig": {
        "sensors": [
            {
                "name": "front_left",
                "nominalSensor2Rig_FLU": {"roll-pitch-yaw": [ROLL_DEG, PITCH_DEG, YAW_DEG], "t": [1.6, 0.5, 1.7]},
                "correction_sensor_R_FLU": {"roll-pitch-yaw": [0.0, 0.0, 0.0]},
                "correction_rig_T": [0.1, 0.0, -0.1],
                "parameter": "camera-name=SF3325",
                "properties": {
                    "Model": "pinhole",
                    "cx": "319.5",
                    "cy": "239.5",
                    "fx": "320.0",
                    "fy": "320.0",
                    "distortion": "0 0 0",
                    "width": "640",
                    "height": "480",
                },
                "protocol": "camera.gmsl",
            },
            {"name": "lidar:top", "protocol": "lidar.socket", "properties": {}},
        ]
    },
    "version": 7,
}


def write_sample(name: str, folder: Path) -> Path:
    """Write the sample of a format into a folder, and return what a user would name."""
    folder.mkdir(parents=True, exist_ok=True)
    texts: dict[str, str] = {
        "urdf": {"shuttle.urdf": URDF, "camera_info/front_left.yaml": CAMERA_INFO},
        "autoware": {
            "sensors_calibration.yaml": AUTOWARE_SENSORS,
            "sensor_kit_calibration.yaml": AUTOWARE_KIT,
            "camera_info/front_left.yaml": CAMERA_INFO,
        },
        "carla-ros-bridge": {"objects.json": json.dumps(BRIDGE, indent=2)},
        "carla-python": {"sensors.txt": PYTHON_SENSORS},
        "nuscenes": {file: json.dumps(rows) for file, rows in NUSCENES.items()},
        "kitti": {"000000.txt": KITTI},
        "opencv": {"front_left.yml": OPENCV},
        "alpasim": {"alpasim.yaml": ALPASIM},
        "driveworks": {"rig.json": json.dumps(DRIVEWORKS)},
        "kalibr": {"camchain.yaml": KALIBR},
    }[name]
    for file, text in texts.items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(text)
    return folder if name == "autoware" else folder / next(iter(texts))
