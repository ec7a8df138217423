"""The tanh-squashed Gaussian on the actor's outputs: its samples, their gradient, and acting on one observation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from acmr.agent.architecture import CLAMP, LOG_STD_BOUNDS, TANH
from acmr.agent.kernels.arrays import Array, array_of, math_of, tensor_of
from acmr.agent.kernels.layers import Dense

_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)
# log_std = low + (high - low) / 2 (tanh(raw) + 1), as center and reach (CleanRL).
_LOW, _HIGH = LOG_STD_BOUNDS[TANH]
_CENTER, _REACH = 0.5 * (_HIGH + _LOW), 0.5 * (_HIGH - _LOW)
#: Keeps the logarithm of the squashing finite (CleanRL).
_SMALL = 1e-6


@dataclass(frozen=True)
class Sample:
    """Actions, (batch, action), their log-probabilities, (batch,), and what the gradient needs of the way there.

    ``bend`` is what the slope of log_std follows from: tanh(raw) where it is squashed, that slope where it is clamped.
    """

    actions: Array
    log_prob: Array
    noise: Array
    std: Array
    bend: Array
    squashed: Array
    slope: Array


class SquashedGaussian:
    """As :meth:`acmr.agent.networks.Actor.sample` defines it.

    Args:
        scale: Half the width of each action's range, (action,).
        bias: Its middle, (action,).
        log_std: How log_std is bounded, ``tanh`` or ``clamp``.
    """

    def __init__(self, scale: Tensor, bias: Tensor, log_std: str = TANH) -> None:
        self._math = math_of(scale)
        self._clamped = log_std == CLAMP
        self._scale, self._bias = array_of(scale), array_of(bias)

    def sample(self, mean: Array, raw: Array, noise: Array) -> Sample:
        """Actions by reparameterization.

        Args:
            mean: The actor's output before squashing, (batch, action).
            raw: Its log_std before it is brought within bounds, (batch, action).
            noise: Standard normal draws, (batch, action).
        """
        if self._clamped:
            log_std = self._math.clip(raw, *LOG_STD_BOUNDS[CLAMP])
            # As autograd has it: at a bound itself the gradient still passes.
            bend = (log_std == raw) * self._math.ones_like(raw)
        else:
            bend = self._math.tanh(raw)
            log_std = bend * _REACH + _CENTER
        std = self._math.exp(log_std)
        # torch's tanh on either device: near +-1 its last bit decides 1 - tanh^2, so it is the one of the networks.
        squashed = array_of(tensor_of(std * noise + mean).tanh_())
        # Change of variables (Haarnoja et al. 2018, appendix C): log pi(a) = log N(x) - log |da/dx|, with
        # a = scale tanh(x) + bias, so da/dx = scale (1 - tanh(x)^2), summed over the actions.
        slope = (1.0 - squashed * squashed) * self._scale
        less = self._math.log(slope + _SMALL) + log_std + noise * noise * 0.5 + _HALF_LOG_2PI
        actions = squashed * self._scale + self._bias
        return Sample(actions, -less.sum(1), noise, std, bend, squashed, slope)

    def backward(self, sample: Sample, of_actions: Array, of_log_prob: Array, of_mean: Array, of_raw: Array) -> None:
        """Writes the gradient of the actor's output.

        With x the Gaussian's draw, t = tanh(x) and s = scale (1 - t^2) = da/dx: dx = s (da + 2 t dlp / (s + 1e-6)).

        Args:
            sample: What was drawn.
            of_actions: Gradient of the actions, (batch, action).
            of_log_prob: Gradient of every log-probability, (1,).
            of_mean: Where the gradient of the mean goes, (batch, action).
            of_raw: Where that of the raw log_std goes, (batch, action).
        """
        # x = mean + std noise, so dmean = dx and dlog_std = dx std noise; log pi also has -log_std itself, by which its
        # gradient is -1. The noise is a constant here, as reparameterization has it.
        pull = sample.squashed / (sample.slope + _SMALL) * (2.0 * of_log_prob)
        of_mean[...] = (pull + of_actions) * sample.slope
        of_log_std = of_mean * sample.std * sample.noise - of_log_prob
        if self._clamped:
            of_raw[...] = of_log_std * sample.bend
        else:
            of_raw[...] = of_log_std * (1.0 - sample.bend * sample.bend) * _REACH


class NumpyPolicy:
    """Samples actions for one observation at a time.

    NumPy's matrix-vector products take a fifth of the time that torch's take here, and read the same memory.

    Args:
        layers: The actor's layers, on the CPU.
        scale: Half the width of each action's range, (action,).
        bias: Its middle, (action,).
        log_std: How log_std is bounded, ``tanh`` or ``clamp``.
    """

    def __init__(self, layers: Sequence[Dense], scale: Tensor, bias: Tensor, log_std: str = TANH) -> None:
        self._layers = [(layer.weight.numpy(), layer.bias.numpy(), layer.relu) for layer in layers]
        self._scale, self._bias = scale.numpy(), bias.numpy()
        self._clamped = log_std == CLAMP

    def __call__(self, observation: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """The action, (action,), for an observation (observation,) and standard normal draws (action,)."""
        # Environments return float64; the weights are float32, and a mixed product would convert them in each step.
        hidden = observation.astype(np.float32)
        for weight, bias, relu in self._layers:
            # More than one network at a time are the adapters of mean and log_std, which read a half each.
            if len(weight) == 1:
                hidden = hidden @ weight[0] + bias[0, 0]
            else:
                hidden = (hidden.reshape(len(weight), 1, -1) @ weight + bias).ravel()
            if relu:
                np.maximum(hidden, 0.0, out=hidden)
        mean, raw = hidden.reshape(2, -1)
        if self._clamped:
            std = np.exp(raw.clip(*LOG_STD_BOUNDS[CLAMP]))
        else:
            std = np.exp(np.tanh(raw) * np.float32(_REACH) + np.float32(_CENTER))
        action: np.ndarray = np.tanh(mean + std * noise) * self._scale + self._bias
        return action
