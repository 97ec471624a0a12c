"""A small capture of the embedded town, recorded once for all tests that look at one."""

from functools import cache

from warpav.scene import PlanSettings, TownSimulator, record

SEED = 3
SETTINGS = PlanSettings(vehicle_count=4, width_px=320, height_px=240)


@cache
def town_capture(seed=SEED, settings=SETTINGS):
    return record(TownSimulator(), seed, settings)
