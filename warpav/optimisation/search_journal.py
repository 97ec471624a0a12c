"""What a search by a pool has been told, so that the same search can be taken again from its beginning.

A search asks for three things that take long: cameras of its pool, selections, and cameras with their Jacobians along a
walk, which is a polish or an ascent of prices. All else follows from the answers. The pool's own cameras are in its
cache, or are drawn again to the same bit; a journal keeps the other answers in order. A search with a journal that has
answers is the same search: it gets what was found then, and asks again only beyond the last answer.

Jacobians are needed only by the walk that they belong to. So they are kept while it goes on, and what is left of one
that has ended are its cameras, what they detect, and the rigs that it came to.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from warpav.core.errors import InputError
from warpav.optimisation.mount import MOUNT_POSE_SIZE
from warpav.optimisation.polish import Detected
from warpav.optimisation.records import named_part, part_of
from warpav.optimisation.selection.relaxation import Price
from warpav.optimisation.selection.select import Selection

State = Mapping[str, np.ndarray]
Detect = Callable[[np.ndarray], Detected]
"""What cameras [camera, 7] detect, and its Jacobian."""
Walked = tuple[np.ndarray, float]
"""A rig that a walk has come to, float32 [camera, 7], and its objective."""
_SELECTION, _WALK = 0, 1
_NUMBERS = ("objective", "bound", "seconds", "nodes")
_PRICE_ARRAYS = ("cut_object", "cut_level", "cut_dual", "row_dual")


@dataclass(frozen=True, eq=False)
class _Sparse:
    """A matrix most of whose numbers are 0, to the bit: which are not, and these.

    Attributes:
        bits: A bit for each number, uint8 [row, byte].
        values: The numbers that are not 0, row by row.
        columns: How many numbers a row has.
    """

    bits: np.ndarray
    values: np.ndarray
    columns: int

    @classmethod
    def of(cls, matrix: np.ndarray) -> _Sparse:
        matrix = np.ascontiguousarray(matrix)
        is_there = matrix.view(f"u{matrix.itemsize}") != 0  # -0.0 is kept
        return cls(np.packbits(is_there, axis=1), matrix[is_there], matrix.shape[1])

    @property
    def whole(self) -> np.ndarray:
        is_there = np.unpackbits(self.bits, axis=1, count=self.columns).astype(bool)
        matrix = np.zeros(is_there.shape, self.values.dtype)
        matrix[is_there] = self.values
        return matrix

    @staticmethod
    def state(matrices: list[_Sparse], dtype: type) -> dict[str, np.ndarray]:
        """Matrices of as many columns below one another."""
        return {
            "bits": np.concatenate([each.bits for each in matrices] or [np.zeros((0, 0), np.uint8)]),
            "values": np.concatenate([each.values for each in matrices] or [np.zeros(0, dtype)]),
            "columns": np.array(matrices[0].columns if matrices else 0),
        }

    @classmethod
    def restored(cls, state: State, rows: np.ndarray) -> list[_Sparse]:
        """Those of a state, of so many rows each, int [matrix].

        Raises:
            ValueError: They do not fit together.
        """
        columns, found, row, value = int(state["columns"]), [], 0, 0
        for count in rows:
            bits = state["bits"][row : row + count]
            size = int(np.unpackbits(bits, axis=1, count=columns).sum())
            found.append(cls(bits, state["values"][value : value + size], columns))
            row, value = row + count, value + size
        shape = (row, -(-columns // 8)) if found else (0, 0)
        if (state["bits"].shape, len(state["values"])) != (shape, value):
            raise ValueError(f"expected bits {shape} and {value} values")
        return found


@dataclass(eq=False)
class _Answer:
    """Cameras that were rendered with their Jacobians.

    Attributes:
        mount_pose: They, float32 [camera, 7].
        pooled: What they detect as the pool has it, [camera, object].
        probability: As the walk was told, float64 [camera, object]; None once it has ended.
        jacobian: Likewise, [camera, object x 7].
    """

    mount_pose: np.ndarray
    pooled: _Sparse
    probability: _Sparse | None
    jacobian: _Sparse | None

    @property
    def detected(self) -> Detected:
        assert self.probability is not None
        assert self.jacobian is not None
        probability = self.probability.whole
        return probability, self.jacobian.whole.reshape(*probability.shape, MOUNT_POSE_SIZE)


@dataclass(eq=False)
class _Walk:
    """A polish or an ascent.

    Attributes:
        answers: What it was told.
        rigs: What it has come to, each with the number of answers before it.
        is_open: Whether it goes on.
    """

    answers: list[_Answer] = field(default_factory=list)
    rigs: list[tuple[int, np.ndarray, float]] = field(default_factory=list)
    is_open: bool = True


class SearchJournal:
    """The answers that a search was given, and the settings under which it asked."""

    def __init__(self, *, is_kept: bool = True) -> None:
        """A journal without an answer.

        Args:
            is_kept: Whether answers are kept at all; without, a search costs no more memory than its pool.
        """
        self._is_kept = is_kept
        self._entries: list[Selection | _Walk] = []
        self._asked = 0
        self._settings: list[tuple[int, dict[str, Any]]] = []  # and the number of entries from which on they hold

    def begin(self, settings: Mapping[str, Any]) -> None:
        """Ask under these settings beyond the last answer; up to it they are what they were."""
        if self._settings and self._settings[-1][1] == dict(settings):
            return
        count = len(self._entries)
        self._settings = [each for each in self._settings if each[0] < count] + [(count, dict(settings))]

    @property
    def settings(self) -> dict[str, Any]:
        """Those under which the search asks now."""
        return next(each for count, each in reversed(self._settings) if count <= self._asked)

    def selection(self, choose: Callable[[], Selection]) -> Selection:
        """The next selection; one that was interrupted is no answer.

        Raises:
            InputError: The journal is one of another search.
        """
        known = self._next()
        if known is None:
            found = choose()
            if found.ended != "interrupted":
                self._keep(found)
            return found
        if not isinstance(known, Selection):
            raise _another()
        return known

    def walk(
        self,
        steps: Callable[[Detect], Iterator[Walked]],
        detect: Detect,
        join: Callable[[np.ndarray, np.ndarray], np.ndarray],
    ) -> Iterator[Walked]:
        """The next walk.

        Args:
            steps: The walk of a function that says what cameras detect.
            detect: That function.
            join: Told of all cameras and what they detect, before the walk is; returns that as it is pooled.

        Yields:
            What the walk comes to.

        Raises:
            InputError: The journal is one of another search.
        """
        known = self._next()
        if known is None:
            known = self._keep(_Walk())
        if not isinstance(known, _Walk):
            raise _another()
        if known.is_open:
            yield from self._walked(known, steps, detect, join)
            return
        told = 0
        for count, rig, objective in [*known.rigs, (len(known.answers), None, 0.0)]:
            for answer in known.answers[told:count]:
                join(answer.mount_pose, answer.pooled.whole)
            told = count
            if rig is not None:
                yield rig, objective

    def _walked(
        self,
        walk: _Walk,
        steps: Callable[[Detect], Iterator[Walked]],
        detect: Detect,
        join: Callable[[np.ndarray, np.ndarray], np.ndarray],
    ) -> Iterator[Walked]:
        """A walk that is taken for the first time, or was left in the middle."""
        told = 0

        def answered(mount_pose: np.ndarray) -> Detected:
            nonlocal told
            pose = np.asarray(mount_pose, np.float32)
            known = walk.answers[told] if told < len(walk.answers) else None
            if known is not None and known.mount_pose.tobytes() != pose.tobytes():
                del walk.answers[told:]  # another machine rounds in another way: the rest of this walk is taken again
                known = None
            probability, jacobian = detect(mount_pose) if known is None else known.detected
            pooled = join(pose, probability)
            if known is None and self._is_kept:
                flat = _Sparse.of(np.asarray(jacobian, np.float64).reshape(len(pose), -1))
                exact = _Sparse.of(np.asarray(probability, np.float64))
                walk.answers.append(_Answer(pose, _Sparse.of(pooled), exact, flat))
            told += 1
            return probability, jacobian

        walk.rigs = []
        for rig, objective in steps(answered):
            if self._is_kept:
                walk.rigs.append((told, rig, objective))
            yield rig, objective
        walk.is_open = False
        for answer in walk.answers:
            answer.probability = answer.jacobian = None

    def _next(self) -> Selection | _Walk | None:
        """The next entry; None where the search asks for the first time."""
        if self._asked >= len(self._entries):
            return None
        self._asked += 1
        return self._entries[self._asked - 1]

    def _keep(self, entry: Any) -> Any:  # noqa: ANN401 (the one that is given)
        if self._is_kept:
            self._entries.append(entry)
            self._asked += 1
        return entry

    def state(self) -> dict[str, np.ndarray]:
        """Everything that `restore` needs, as arrays of numbers and text."""
        walks = [each for each in self._entries if isinstance(each, _Walk)]
        selections = [each for each in self._entries if isinstance(each, Selection)]
        answers = [answer for walk in walks for answer in walk.answers]
        told = [answer for answer in answers if answer.jacobian is not None]  # those of the walk that goes on
        rigs = [rig for walk in walks for rig in walk.rigs]
        no_pose = np.zeros((0, MOUNT_POSE_SIZE), np.float32)
        state = {
            "settings": np.array(json.dumps(self._settings)),
            "entries": np.array([_WALK if isinstance(each, _Walk) else _SELECTION for each in self._entries], np.uint8),
            "walk_answers": np.array([len(walk.answers) for walk in walks], int),
            "walk_rigs": np.array([len(walk.rigs) for walk in walks], int),
            "walk_is_open": np.array([walk.is_open for walk in walks], bool),
            "rig_answers": np.array([count for count, _, _ in rigs], int),
            "rig_cameras": np.array([len(rig) for _, rig, _ in rigs], int),
            "rig_pose": np.concatenate([rig for _, rig, _ in rigs] or [no_pose]),
            "rig_objective": np.array([objective for _, _, objective in rigs], float),
            "answer_cameras": np.array([len(answer.mount_pose) for answer in answers], int),
            "answer_pose": np.concatenate([answer.mount_pose for answer in answers] or [no_pose]),
            **named_part("pooled", _Sparse.state([answer.pooled for answer in answers], np.float32)),
            **named_part("told_probability", _Sparse.state([each.probability for each in told], np.float64)),  # pyright: ignore[reportArgumentType]
            **named_part("told_jacobian", _Sparse.state([each.jacobian for each in told], np.float64)),  # pyright: ignore[reportArgumentType]
        }
        for number, selection in enumerate(selections):
            state |= named_part(f"selection_{number}", _selection_state(selection))
        return state

    def restore(self, state: State) -> None:
        """Become the journal of a search that gave `state`; the search begins again.

        Raises:
            KeyError: The state is not whole.
            ValueError: Its parts do not fit together.
        """
        cameras, told_from = state["answer_cameras"], 0
        ends = np.cumsum(cameras)
        pose = np.split(np.asarray(state["answer_pose"], np.float32), ends[:-1]) if len(cameras) else []
        answers = [
            _Answer(each, pooled, None, None)
            for each, pooled in zip(pose, _Sparse.restored(part_of(state, "pooled"), cameras), strict=True)
        ]
        is_open = state["walk_is_open"]
        if len(is_open) and is_open[-1]:
            told_from = len(answers) - int(state["walk_answers"][-1])
            probability, jacobian = (
                _Sparse.restored(part_of(state, name), cameras[told_from:])
                for name in ("told_probability", "told_jacobian")
            )
            for answer, exact, flat in zip(answers[told_from:], probability, jacobian, strict=True):
                answer.probability, answer.jacobian = exact, flat
        rig_pose = np.split(np.asarray(state["rig_pose"], np.float32), np.cumsum(state["rig_cameras"]))
        rigs = [
            (int(count), each, float(objective))
            for count, each, objective in zip(
                state["rig_answers"], rig_pose[: len(state["rig_answers"])], state["rig_objective"], strict=True
            )
        ]
        self._entries, self._asked, walks = [], 0, 0
        self._settings = [(int(count), dict(settings)) for count, settings in json.loads(str(state["settings"]))]
        for kind in state["entries"]:
            if kind == _SELECTION:
                number = len(self._entries) - walks
                self._entries.append(_restored_selection(part_of(state, f"selection_{number}")))
                continue
            own_answers, own_rigs = int(state["walk_answers"][walks]), int(state["walk_rigs"][walks])
            self._entries.append(_Walk(answers[:own_answers], rigs[:own_rigs], bool(is_open[walks])))
            answers, rigs, walks = answers[own_answers:], rigs[own_rigs:], walks + 1


def _another() -> InputError:
    return InputError("checkpoint: expected that of this search, got one of another; was warpav changed in between?")


def _selection_state(selection: Selection) -> dict[str, np.ndarray]:
    price = selection.price
    state = {
        "cameras": selection.cameras,
        "numbers": np.array([getattr(selection, name) for name in _NUMBERS], float),
        "ended": np.array(selection.ended),
        "others": np.array(selection.others, np.int64),
    }
    if price is not None:
        state["price_numbers"] = np.array([price.bound, price.dearest, price.object_count], float)
        state |= {f"price_{name}": getattr(price, name) for name in _PRICE_ARRAYS}
    return state


def _restored_selection(state: State) -> Selection:
    objective, bound, seconds, nodes = (float(each) for each in state["numbers"])
    price = None
    if "price_numbers" in state:
        lowest, dearest, objects = (float(each) for each in state["price_numbers"])
        arrays = {name: np.array(state[f"price_{name}"]) for name in _PRICE_ARRAYS}
        price = Price(bound=lowest, object_count=int(objects), dearest=dearest, **arrays)
    found = Selection(np.array(state["cameras"]), objective, bound, "gap", seconds, int(nodes), price)
    return replace(found, ended=str(state["ended"]), others=tuple(np.array(each) for each in state["others"]))  # pyright: ignore[reportArgumentType]
