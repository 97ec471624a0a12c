"""A detector from an ONNX file, run by onnxruntime: the session, its provider, batches, classes and suppression.

What the file's inputs want and its outputs mean is the matter of `warpav.detection.families`. How the shipped detector
was trained and its accuracy: see ``models/MODEL_CARD.md``.
"""

from __future__ import annotations

import html
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpav.core.bounded_files import read_text
from warpav.core.cores import available_cores
from warpav.core.errors import InputError, OptionError
from warpav.core.records import nearest
from warpav.detection._detector import ROAD_USERS, Detections
from warpav.detection._external_data import check_external_data
from warpav.detection.families import recognise
from warpav.detection.families._family import Asked, Letterbox, NetworkFile, Tensor, metadata_labels

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

BUILTIN_MODEL_PATH = Path(__file__).parent / "models" / "warpav_town_nano.onnx"

# Labels that mean a road user, as COCO (both spellings of its motorcycle), other street data sets and the shipped
# detector name them. COCO's bicycle is none: it marks the thing alone, ridden or parked, while its rider is a person.
_ROAD_USER_LABELS = {
    "vehicle": ("car", "van", "truck", "lorry", "bus", "motorcycle", "motorbike", "vehicle"),
    "pedestrian": ("pedestrian", "person", "people"),
    "cyclist": ("cyclist", "bicyclist", "rider"),
}
_PROVIDERS = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider", "tensorrt": "TensorrtExecutionProvider"}

_BATCH_MAX = 32
# Beyond this many candidates the least confident are dropped.
_CANDIDATE_MAX = 1000
_TORCH_SUFFIXES = (".pt", ".pth", ".torchscript")


def suppress(
    box_px: np.ndarray, confidence: np.ndarray, *, iou_max: float, class_index: np.ndarray | None = None
) -> np.ndarray:
    """Non-maximum suppression of boxes [box, 4]: keep the surest, drop what overlaps it, repeat; returns the kept.

    With ``class_index`` [box] boxes of the same class leave each other alone.
    """
    order = np.argsort(-confidence, kind="stable")[:_CANDIDATE_MAX]
    box = np.asarray(box_px, np.float64)[order].reshape(-1, 4)
    area = (box[:, 2] - box[:, 0]) * (box[:, 3] - box[:, 1])
    left = np.arange(len(order))
    kept = []
    while len(left):
        best, left = left[0], left[1:]
        kept.append(best)
        x0, y0, x1, y1 = box[best]
        rest = box[left]
        width = np.minimum(rest[:, 2], x1) - np.maximum(rest[:, 0], x0)
        height = np.minimum(rest[:, 3], y1) - np.maximum(rest[:, 1], y0)
        shared = np.where((width > 0.0) & (height > 0.0), width * height, 0.0)
        stays = shared <= iou_max * (area[left] + area[best] - shared)
        if class_index is not None:
            stays |= class_index[order[left]] == class_index[order[best]]
        left = left[stays]
    return order[kept]


@dataclass(frozen=True)
class _DetectorOptions:
    """How a network is read.

    Attributes:
        labels: Labels in the order of the network's classes, or a file with one a line; None: the file's metadata, else
            COCO's if implied by the number of classes or by the family.
        classes: Labels that count as a kind of road user, in place of the usual ones.
        targets: Kinds of road users to detect, out of `ROAD_USERS`; None: vehicles, and all others that
            it has labels for.
        input_px: Images are scaled so that their longer side has this many pixels, and padded to multiples of 32; a
            family that wants a square gets one of this side. None: as they are, or the family's own. A file that fixes
            its input size takes none.
    """

    confidence_min: float = 0.1
    nms_iou_max: float = 0.65
    family: str = "auto"
    labels: Sequence[str] | Path | str | None = None
    classes: Mapping[str, Sequence[str] | None] | None = None
    targets: Sequence[str] | None = ("vehicle",)
    input_px: int | None = None
    threads: int | None = None
    provider: str = "cpu"


class OnnxDetector:
    """Road users in images, by an ONNX network.

    Each kind of road user is detected as if it were the only one: a candidate counts with the best score among the
    labels of that kind, and suppression never crosses kinds. A network that suppresses by itself is trusted within a
    label; only boxes of different labels of one kind, as car and truck, still give way to each other.
    """

    def __init__(self, model: str | Path, **options: Any) -> None:  # noqa: ANN401
        """The detector in a file, or ``builtin``; ``options`` are the fields of `_DetectorOptions`."""
        self._options = given = _DetectorOptions(**options)
        targets, input_px = given.targets, given.input_px
        if targets is not None and (not targets or not set(targets) <= set(ROAD_USERS)):
            raise ValueError(f"targets must be some of {ROAD_USERS}, got {targets}")
        self._path = BUILTIN_MODEL_PATH if str(model) == "builtin" else Path(model).expanduser()
        self._session = _open_session(self._path, given.threads, given.provider)
        self.family, self.reason = recognise(self._read_file(given.labels), given.family)
        self.file = self.family.file
        size_px = self.file.size_px
        if input_px is not None and size_px not in (None, (input_px, input_px)):
            rows, columns = size_px or (0, 0)
            raise InputError(
                f"{self._path}: the file fixes its input at {rows} x {columns} pixels, so leave detector.input_px out, "
                f"got {input_px}; or export the network with dynamic size"
            )
        self._classes = self._sort_labels(given.classes or {}, targets)

    def __repr__(self) -> str:
        return f"OnnxDetector({self._path.name}, {self.family.name}, {', '.join(self.road_users)})"

    def _repr_html_(self) -> str:
        """What Jupyter shows: the file, how it is read, and which labels count."""
        rows = {
            "file": self._path.name,
            "layout": self.family.name,
            **{user: ", ".join(labels) for user, labels in self.road_users.items()},
            "least confidence": f"{self._options.confidence_min:g}",
            "runs on": ", ".join(self.providers_used),
        }
        cells = "".join(
            f"<tr><th>{html.escape(name)}</th><td>{html.escape(text)}</td></tr>" for name, text in rows.items()
        )
        return f"<table><caption>Detector</caption><tbody>{cells}</tbody></table>"

    @property
    def names(self) -> tuple[str, ...]:
        """Every label of the network; only those that count as a wanted road user are given to detections."""
        return self.file.labels or ()

    @property
    def road_users(self) -> dict[str, tuple[str, ...]]:
        """The labels that count as each kind of road user that is detected."""
        return {user: tuple(self.names[index] for index in classes) for user, classes in self._classes.items()}

    @property
    def providers_used(self) -> tuple[str, ...]:
        """What onnxruntime runs the network on, first choice first, in its own words."""
        return tuple(self._session.get_providers())

    def input_size_px(self, height_px: int, width_px: int) -> tuple[int, int]:
        """Rows and columns of the network's input for an image of this size."""
        return self.family.input_size_px(height_px, width_px, self._options.input_px)

    @property
    def takes_any_size(self) -> bool:
        """Whether images of any size go into the network as they are, unless ``input_px`` says otherwise."""
        return (
            self.file.size_px is None and self.family.square_px is None and self.family.image.shape[-2:] == (None,) * 2
        )

    def network_scale(self, height_px: int, width_px: int) -> tuple[float, float]:
        """Pixels of the network's input for one of an image of this size, along x and y."""
        letterbox = self._letterbox(height_px, width_px)
        return letterbox.scaled_width_px / width_px, letterbox.scaled_height_px / height_px

    def _letterbox(self, height_px: int, width_px: int) -> Letterbox:
        return Letterbox.fit(height_px, width_px, *self.input_size_px(height_px, width_px), self.family.placement)

    def detect(self, images_rgb: np.ndarray | Sequence[np.ndarray]) -> list[Detections]:
        """Find the road users in every image, uint8 [image, row, column, 3], all of one size."""
        if len(images_rgb) == 0:
            return []
        images_rgb = np.asarray(images_rgb)
        if images_rgb.ndim != 4 or images_rgb.shape[3] != 3 or images_rgb.dtype != np.uint8 or 0 in images_rgb.shape:
            raise ValueError(
                "images_rgb must be uint8 [image, row, column, 3] with at least one pixel, got "
                f"{images_rgb.dtype} {images_rgb.shape}"
            )
        height_px, width_px = images_rgb.shape[1:3]
        letterbox = self._letterbox(height_px, width_px)
        outputs = self._run(self.family.pack(images_rgb, letterbox))
        return [self._decode(each, letterbox, height_px, width_px) for each in outputs]

    def takes_tensor(self, height_px: int, width_px: int) -> bool:
        """Whether images of this size go into the network as they are: RGB in 0..1, neither scaled nor padded."""
        return self.family.takes_unit_rgb and self.input_size_px(height_px, width_px) == (height_px, width_px)

    def detect_tensor(self, network_input: Any) -> list[Detections]:  # noqa: ANN401 (a DLPack capsule has no type)
        """Find the road users in images that are laid out for the network, without a copy where that can be.

        Anything with the DLPack protocol: RGB in 0..1, float32 [image, 3, row, column], of a size that `takes_tensor`.
        """
        import warp as wp

        array: Any = network_input if isinstance(network_input, wp.array) else wp.from_dlpack(network_input)
        if array.ndim != 4 or array.shape[1] != 3 or array.dtype != wp.float32 or not array.is_contiguous:
            raise ValueError(
                f"network_input must be contiguous float32 [image, 3, row, column], got {array.dtype} {array.shape}"
            )
        image_count, _, height_px, width_px = array.shape
        if not self.takes_tensor(height_px, width_px):
            raise ValueError(f"the network takes no images of {width_px} x {height_px} pixels as they are")
        if image_count == 0:
            return []
        if array.device.is_cuda and self._options.provider != "cpu" and self.family.takes_device_tensor:
            outputs = self._run_on_device(array)
        else:
            outputs = self._run(array.numpy())  # on the CPU a view, not a copy
        letterbox = Letterbox.fit(height_px, width_px, height_px, width_px)
        return [self._decode(each, letterbox, height_px, width_px) for each in outputs]

    def _run_on_device(self, array: Any) -> list[tuple[np.ndarray, ...]]:  # noqa: ANN401 (a Warp array on a GPU)
        """The network's outputs for an input on the GPU, read where it lies; one for every image."""
        import warp as wp

        wp.synchronize_device(array.device)  # the network runs on a stream of its own
        binding = self._session.io_binding()
        name = self.family.image.name
        binding.bind_input(name, "cuda", array.device.ordinal, np.float32, list(array.shape), array.ptr)
        for output in self.file.outputs:
            binding.bind_output(output.name)
        try:
            self._session.run_with_iobinding(binding)
        except Exception as error:  # onnxruntime's own types share no parent
            raise InputError(f"{self._path}: cannot run on {array.device}: {_short(error)}") from error
        return self.family.each_image(self._checked(binding.copy_outputs_to_cpu()), len(array))

    def _run(self, network_input: np.ndarray) -> list[tuple[np.ndarray, ...]]:
        fixed = self.family.batch
        batch = fixed or min(_BATCH_MAX, len(network_input))
        outputs = []
        for start in range(0, len(network_input), batch):
            part = network_input[start : start + batch]
            missing = batch - len(part) if fixed else 0
            if missing:
                part = np.concatenate([part, np.zeros((missing, *part.shape[1:]), np.float32)])
            arrays = self._checked(self._run_session(self.family.feed(part)))
            outputs += self.family.each_image(arrays, len(part))[: len(part) - missing]
        return outputs

    def _run_session(self, feed: dict[str, np.ndarray]) -> list[np.ndarray]:
        try:
            return [np.asarray(output) for output in self._session.run(None, feed)]
        except Exception as error:  # onnxruntime's own types share no parent
            came = ", ".join(f"{name} {list(array.shape)} {array.dtype}" for name, array in feed.items())
            raise InputError(f"{self._path}: cannot run on input {came}: {_short(error)}") from error

    def _checked(self, outputs: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The network's outputs, single precision at least, if all numbers are finite."""
        checked = []
        for tensor, array in zip(self.file.outputs, outputs, strict=True):
            if not np.isfinite(array).all():
                hint = ", or export it in float32" if self.family.image.dtype == "float16" else ""
                raise InputError(
                    f"{self._path}: output {tensor.name} holds numbers that are not finite, expected boxes and scores; "
                    f"check the network's input{hint}"
                )
            checked.append(array.astype(np.float32) if array.dtype == np.float16 else array)
        return checked

    def _decode(
        self, outputs: tuple[np.ndarray, ...], letterbox: Letterbox, height_px: int, width_px: int
    ) -> Detections:
        size_px = (letterbox.input_height_px, letterbox.input_width_px)
        parts = []
        for user, classes in self._classes.items():
            found = self.family.decode(outputs, Asked(size_px, classes, self._options.confidence_min))
            kept = suppress(
                found.box_input_px,
                found.confidence,
                iou_max=self._options.nms_iou_max,
                class_index=found.class_index if self.family.suppresses else None,
            )
            box_px = letterbox.unpack(found.box_input_px[kept], height_px, width_px)
            # Boxes that lie in the grey border alone are cut down to nothing.
            solid = (box_px[:, 2:] > box_px[:, :2]).all(axis=1)
            kept = kept[solid]
            user_index = np.full(len(kept), ROAD_USERS.index(user), np.int32)
            parts.append((box_px[solid], found.confidence[kept], found.class_index[kept], user_index))
        box_px, confidence, class_index, user_index = (np.concatenate(part) for part in zip(*parts, strict=True))
        order = np.argsort(-confidence, kind="stable")
        return Detections(
            box_px[order],
            np.minimum(confidence[order], 1.0).astype(np.float32),
            class_index[order].astype(np.int32),
            self.names,
            user_index[order],
        )

    def _read_file(self, labels: Sequence[str] | Path | str | None) -> NetworkFile:
        try:
            inputs, outputs = (
                tuple(Tensor.described(each.name, each.shape, each.type) for each in listed)
                for listed in (self._session.get_inputs(), self._session.get_outputs())
            )
            metadata = dict(self._session.get_modelmeta().custom_metadata_map)
        except UnicodeDecodeError:
            raise InputError(f"{self._path}: expected names and metadata in UTF-8, got another encoding") from None
        if labels is not None:
            known, origin = _given_labels(labels), "detector.labels"
        else:
            known, origin = metadata_labels(self._path, metadata), "the file's metadata"
        return NetworkFile(self._path, inputs, outputs, metadata, known, origin, self._run_session)

    def _sort_labels(
        self, classes: Mapping[str, Sequence[str] | None], targets: Sequence[str] | None
    ) -> dict[str, np.ndarray]:
        """The network's classes of every kind of road user that is wanted, int32."""
        index: dict[str, list[int]] = {}
        for k, name in enumerate(self.names):
            index.setdefault(name.lower(), []).append(k)
        named: dict[str, str] = {}
        for user, labels in classes.items():
            for label in (label.lower() for label in labels or ()):
                if label not in index:
                    expected = f"labels of {self._path} ({_short(', '.join(self.names))})"
                    hint = nearest(label, index)
                    raise OptionError(f"detector.classes.{user}", f"expected {expected}, got {label!r}{hint}")
                if named.setdefault(label, user) != user:
                    raise OptionError(
                        "detector.classes", f"expected {label!r} in one list, got it in {named[label]} and {user}"
                    )
        found: dict[str, np.ndarray] = {}
        for user in ROAD_USERS:
            given = classes.get(user)
            # A label that the user assigns to one kind of road user belongs to no other kind.
            usual = [label for label in _ROAD_USER_LABELS[user] if named.get(label, user) == user]
            wanted = usual if given is None else [label.lower() for label in given]
            found[user] = np.array(sorted({k for label in wanted for k in index.get(label, ())}), np.int32)
            if len(found[user]) == 0 and user in (("vehicle",) if targets is None else targets):
                known = _short(", ".join(self.names))
                raise InputError(
                    f"{self._path}: none of its labels ({known}) means a {user} ({', '.join(wanted)}); "
                    f"name those that do in detector.classes.{user}"
                )
        return {user: found[user] for user in ROAD_USERS if len(found[user]) and (targets is None or user in targets)}


def _given_labels(labels: Sequence[str] | Path | str) -> tuple[str, ...]:
    """Labels as the user gave them: a list, or a file with one a line."""
    if not isinstance(labels, (str, Path)):
        given = tuple(str(label).strip() for label in labels)
    else:
        try:
            text = read_text(Path(labels).expanduser(), "a text file with one label a line")
        except InputError as error:
            raise OptionError("detector.labels", str(error)) from None
        given = tuple(line.strip() for line in text.rstrip().splitlines())
    if not given or "" in given:
        raise OptionError(
            "detector.labels", f"expected a label for every class, got {'none' if not given else 'an empty one'}"
        )
    return given


def _open_session(path: Path, threads: int | None, provider: str) -> InferenceSession:
    import onnxruntime

    known = {name: full for name, full in _PROVIDERS.items() if full in onnxruntime.get_available_providers()}
    if provider not in known:
        raise OptionError(
            "detector.provider",
            f"expected one of {', '.join(known)}, which onnxruntime offers here, got {provider!r}; "
            "for a GPU install onnxruntime-gpu in place of onnxruntime",
        )
    if not path.is_file():
        raise InputError(f"detector.model: no such file: {path}; give the path of an ONNX file, or builtin")
    if path.suffix.lower() in _TORCH_SUFFIXES:
        raise InputError(
            f"{path}: expected an ONNX file, got weights of PyTorch; those of Ultralytics become one by "
            f"`yolo export model={path} format=onnx`"
        )
    check_external_data(path)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    # Threads that wait in a loop for the next layer would take the cores that render meanwhile.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    cores = available_cores()
    if threads is not None or cores < (os.cpu_count() or 1):  # onnxruntime would take all cores of the machine
        options.intra_op_num_threads = threads or cores
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=[known[provider]])
    except Exception as error:  # onnxruntime's own types share no parent
        if "external" in str(error).lower():
            raise InputError(
                f"{path}: its weights lie in another file, which must be next to it, but cannot be read: "
                f"{_short(error, 600)}"
            ) from error
        raise InputError(f"{path}: not an ONNX file that onnxruntime can load: {_short(error)}") from error
    if session.get_providers()[0] != known[provider]:
        raise OptionError(
            "detector.provider",
            f"expected the network to run on {provider}, but onnxruntime fell back to "
            f"{session.get_providers()[0]}; check the GPU's driver and CUDA libraries, or set detector.provider=cpu",
        )
    return session


def _short(error: object, longest: int = 200) -> str:
    text = " ".join(str(error).split())
    return text if len(text) <= longest else f"{text[: longest // 2]} ... {text[-longest // 2 :]}"
