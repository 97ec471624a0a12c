"""Steps on a few numbers: AdamW, and plain ascent of the multipliers of inequalities."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

BETAS = (np.float32(0.9), np.float32(0.999))
EPSILON = np.float32(1e-8)


class AdamW:
    """Adam with bias correction, weight decay decoupled from the gradient, in single precision.

    Source: Loshchilov and Hutter, Decoupled Weight Decay Regularization, 2019, algorithm 2.

    Attributes:
        value: The numbers now, float32; every step makes a new array.
    """

    def __init__(self, value: np.ndarray, *, weight_decay: float) -> None:
        """State for ``value``, any shape."""
        self._weight_decay = np.float32(weight_decay)
        self.value = np.array(value, np.float32)
        self._first_moment, self._second_moment = np.zeros_like(self.value), np.zeros_like(self.value)
        self._step_number = 0

    def step(self, gradient: np.ndarray, step_size: np.ndarray) -> None:
        """One step; a negative step size ascends, 0 leaves a number and its moments alone. Shapes as ``value``."""
        self._step_number += 1
        gradient, rate = np.asarray(gradient, np.float32), np.asarray(step_size, np.float32)
        moves = rate != 0.0
        beta1, beta2 = BETAS
        one = np.float32(1.0)
        first = beta1 * self._first_moment + (one - beta1) * gradient
        second = beta2 * self._second_moment + (one - beta2) * gradient * gradient
        unbiased_first, unbiased_second = (
            moment / (one - beta ** np.float32(self._step_number)) for moment, beta in ((first, beta1), (second, beta2))
        )
        decayed = self.value * (one - np.abs(rate) * self._weight_decay)
        stepped = decayed - rate * unbiased_first / (np.sqrt(unbiased_second) + EPSILON)
        self._first_moment = np.where(moves, first, self._first_moment)
        self._second_moment = np.where(moves, second, self._second_moment)
        self.value = np.where(moves, stepped, self.value)

    def state(self) -> dict[str, np.ndarray]:
        """Everything that `restore` needs."""
        return {
            "value": self.value,
            "first_moment": self._first_moment,
            "second_moment": self._second_moment,
            "step_number": np.array(self._step_number),
        }

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a state."""
        self.value = np.array(state["value"], np.float32)
        self._first_moment = np.array(state["first_moment"], np.float32)
        self._second_moment = np.array(state["second_moment"], np.float32)
        self._step_number = int(state["step_number"])


class MultiplierAscent:
    """Plain gradient steps on the multipliers of inequalities, which are never negative.

    Attributes:
        value: The multipliers now, float32; every step makes a new array.
    """

    def __init__(self, value: np.ndarray) -> None:
        """State for ``value``, any shape, at least 0."""
        self.value = np.array(value, np.float32)

    def step(self, gradient: np.ndarray, step_size: np.ndarray) -> None:
        """One step, as `AdamW.step` counts them: a negative step size ascends. Shapes as ``value``."""
        self.value = np.maximum(self.value - np.asarray(step_size * gradient, np.float32), np.float32(0.0))

    def state(self) -> dict[str, np.ndarray]:
        """Everything that `restore` needs."""
        return {"value": self.value}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a state."""
        self.value = np.array(state["value"], np.float32)
