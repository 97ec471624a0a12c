"""The labels of COCO, by class of networks that were trained on it."""

from __future__ import annotations

BACKGROUND = "__background__"

_COCO_GAPS = {12, 26, 29, 30, 45, 66, 68, 69, 71, 83}
_COCO_LABELS = """
person bicycle car motorcycle airplane bus train truck boat traffic_light fire_hydrant stop_sign parking_meter bench
bird cat dog horse sheep cow elephant bear zebra giraffe backpack umbrella handbag tie suitcase frisbee skis
snowboard sports_ball kite baseball_bat baseball_glove skateboard surfboard tennis_racket bottle wine_glass cup fork
knife spoon bowl banana apple sandwich orange broccoli carrot hot_dog pizza donut cake chair couch potted_plant bed
dining_table toilet tv laptop mouse remote keyboard cell_phone microwave oven toaster sink refrigerator book clock
vase scissors teddy_bear hair_drier toothbrush
"""
COCO_80 = tuple(label.replace("_", " ") for label in _COCO_LABELS.split())


def _coco_91() -> tuple[str, ...]:
    """COCO's labels at COCO's own numbers, which leave ten out; 0 is the background."""
    labels = iter(COCO_80)
    return (BACKGROUND, *("N/A" if number in _COCO_GAPS else next(labels) for number in range(1, 91)))


COCO_91 = _coco_91()
