"""A small capture of the embedded town, recorded once for all tests that look at one."""

from functools import cache

from warpav.capture.capture import Capture
from warpav.capture.plan import PlanSettings, capture_plan, spawn_visible_traffic
from warpav.capture.town_simulator import TownSimulator

SEED = 3
SETTINGS = PlanSettings(vehicle_count=4, width_px=320, height_px=240)


@cache
def town_capture(seed=SEED, settings=SETTINGS):
    simulator = TownSimulator()
    ego_box = simulator.begin(seed)
    vehicles = spawn_visible_traffic(simulator, ego_box, settings)
    images = [simulator.look(view) for view in capture_plan(ego_box, vehicles, settings)]
    return Capture(simulator.name, simulator.source, ego_box, vehicles, images)
