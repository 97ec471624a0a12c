"""The layouts of ONNX detectors: how each wants its images, and how its outputs become boxes.

An ONNX file states names, shapes and types of its inputs and outputs, but not what the numbers mean. Networks of
one *family* share that meaning. `recognise` finds the family of a file (the user's option wins, then the
file's metadata, then its inputs and outputs) together with the reason in words; from there on a `Family` packs
images into the network's input and decodes its outputs into ``Candidates``, boxes in pixels of that input.

======================= ============================ ===================================================================
format                  images                       outputs
======================= ============================ ===================================================================
``ultralytics``         RGB 0..1, centred on grey    [b, 4 + classes, n], [b, n, 4 + classes]: centre, size [px], scores
``ultralytics-end2end`` RGB 0..1, centred on grey    [b, n, 6]: x0, y0, x1, y1 [px], score, class
``ultralytics-rtdetr``  RGB 0..1, stretched          [b, n, 6]: centre, size in 0..1, score, class
``yolox``               BGR 0..255, top left on grey [b, n, 5 + classes]: offset, log size [cells], objectness, scores
``yolox-decoded``       BGR 0..255, top left on grey [b, n, 5 + classes]: centre, size [px], objectness, scores
``yolov5``              RGB 0..1, centred on grey    [b, 3 n, 5 + classes]: centre, size [px], objectness, scores
``torchvision``         RGB 0..1, top left on grey   boxes, labels, scores in any order; class 0 is the background
``rtdetr``              RGB 0..1, stretched          labels, boxes, scores; second input: the size that boxes refer to
``rtdetr-single``       RGB 0..1, stretched          [b, n, 6]: x0, y0, x1, y1 [px], score, class
======================= ============================ ===================================================================

RT-DETR and D-FINE are trained, evaluated and deployed on images that are stretched to the square input, whatever their
shape, and so is ultralytics' RT-DETR; none of them is letterboxed here. torchvision pads its own batches at the right
and the bottom with what is the mean colour, a grey, after its normalisation.

A new family is one class in `_layouts` and its row in `FAMILIES`.
"""

from __future__ import annotations

from dataclasses import replace

from warpav.core.errors import InputError, OptionError
from warpav.detection.families._family import BACKGROUND, COCO_80, COCO_91, Family, NetworkFile
from warpav.detection.families._layouts import (
    Rtdetr,
    RtdetrSingle,
    Torchvision,
    Ultralytics,
    UltralyticsEndToEnd,
    UltralyticsRtdetr,
    YoloV5,
    Yolox,
    YoloxDecoded,
)

FAMILIES: tuple[type[Family], ...] = (
    Ultralytics,
    UltralyticsEndToEnd,
    UltralyticsRtdetr,
    Yolox,
    YoloxDecoded,
    YoloV5,
    Torchvision,
    Rtdetr,
    RtdetrSingle,
)


def recognise(file: NetworkFile, name: str = "auto") -> tuple[Family, str]:
    """Find out how a file wants its images and what its outputs mean."""
    by_name = {family.name: family for family in FAMILIES}
    if name != "auto" and name not in by_name:
        raise OptionError("detector.format", f"expected auto or one of {', '.join(by_name)}, got {name!r}")
    if name != "auto":
        kind, reason = by_name[name], "set by detector.format"
        if not kind.fits(file):
            wanted = kind.layout if file.labels is None else f"{kind.layout}, with {len(file.labels)} labels"
            raise InputError(f"{file.path}: detector.format={name}: expected {wanted}, got {file}")
    else:
        fitting = [family for family in FAMILIES if family.fits(file)]
        if not fitting:
            known = "; ".join(f"{family.name}: {family.layout}" for family in FAMILIES)
            raise InputError(f"{file.path}: unknown layout, got {file}; expected one of {known}")
        known = [(family, why) for family in fitting if (why := family.evidence(file)) is not None]
        if len(known) != 1:
            names = ", ".join(family.name for family, _ in known) or ", ".join(family.name for family in fitting)
            raise InputError(
                f"{file.path}: its layout could be one of {names}, got {file}; name one with detector.format"
                + ("" if file.labels or UltralyticsEndToEnd.fits(file) else ", or its labels with detector.labels")
            )
        kind, reason = known[0]
    labels, origin = _labels(file, kind)
    return kind(replace(file, labels=labels, labels_origin=origin)), reason


def _labels(file: NetworkFile, kind: type[Family]) -> tuple[tuple[str, ...], str]:
    """The labels by class of the network, and where they come from; class 0 is the background where there is one."""
    if file.labels is not None:
        if kind is Torchvision and file.labels[0].lower() not in (BACKGROUND, "background"):
            return (BACKGROUND, *file.labels), file.labels_origin
        return file.labels, file.labels_origin
    count = kind(file).class_count
    if count == len(COCO_80):
        return COCO_80, "COCO, for there are 80 classes"
    if count == len(COCO_91):
        return COCO_91, "COCO with its gaps, for there are 91 classes"
    if kind.assumed_labels is not None:
        return (
            kind.assumed_labels,
            "COCO (assumed, since the file has no labels; if it was trained on others, set detector.labels)",
        )
    classes = "an unknown number of" if count is None else count
    raise InputError(
        f"{file.path}: has no metadata 'names' for the {classes} classes of output {file.outputs[0]}, so its labels "
        "are unknown; set detector.labels to their list, or to a file with one label a line"
    )
