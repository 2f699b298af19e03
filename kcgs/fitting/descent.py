"""What the loop and the trials of strategies do with a state: render, step downhill, measure."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcgs.functional import region_splat, ssim

from .state import FitState, Gaussians, HistoryEntry

# about how many entries the history gets
_HISTORY_POINTS = 100
# weight of 1 - SSIM beside the mean absolute error, as Image-GS has it
_SSIM_WEIGHT = 0.1


def render(state: FitState, gaussians: Gaussians | None = None) -> Tensor:
    """Render (C, H, W): these Gaussians, or those of the moment."""
    means, cholesky, colors, region_ids, regions = gaussians or state.gaussians()
    settings = {"size": state.size, "cutoff": state.cutoff, "backend": state.config.backend}
    rendered = region_splat(means, cholesky, colors, region_ids, regions, **settings)  # type: ignore[arg-type]
    return rendered.clamp(0.0, 1.0) if state.clamp else rendered


def squared_error(state: FitState, gaussians: Gaussians | None = None) -> Tensor:
    """Squared error of each pixel, (H, W), channels averaged."""
    return (render(state, gaussians).detach() - state.image).square().mean(0)


def descend(state: FitState, rendered: Tensor, progress: float) -> None:
    """Move the Gaussians downhill from a render of them."""
    _backward(state, rendered)
    state.optimizer.step(state.optimizer.decay(progress))
    state.iteration += 1


def _backward(state: FitState, rendered: Tensor) -> None:
    """Leave the gradient of the loss at the Gaussians, but for a constant, which no optimizer here feels."""
    if state.config.loss == "l2":
        # in the render's own memory, which nothing needs again: new memory would take as long as the sum
        difference = rendered.data.sub_(state.image)
        rendered.backward(difference if state.objective is None else state.objective.apply(difference))
        return
    difference = torch.sub(rendered.detach(), state.image).sign_()
    if state.config.loss == "l1+ssim":
        leaf = rendered.detach().requires_grad_()
        (slope,) = torch.autograd.grad(ssim(leaf, state.image), leaf)
        difference -= _SSIM_WEIGHT * leaf.numel() * slope
    rendered.backward(difference)


def log_is_due(state: FitState) -> bool:
    """Say whether the history wants an entry: about a hundred over the fit, of no more than N Gaussians."""
    config = state.config
    if state.count() > state.num_gaussians:
        return False
    if config.max_seconds is None:
        return state.iteration % max(1, config.usual_iterations // _HISTORY_POINTS) == 0
    due = state.history[-1].seconds + config.max_seconds / _HISTORY_POINTS if state.history else 0.0
    return state.seconds() >= due


def log(state: FitState, rendered: Tensor, gaussians: Gaussians | None = None) -> None:
    """Measure a render of these Gaussians, or of those of the moment, and keep them if they are the best so far."""
    gaussians = gaussians or state.gaussians()
    difference = rendered.detach() - state.image
    loss = float(difference.square().mean() if state.config.loss == "l2" else difference.abs().mean())
    difference = rendered.detach().clamp(0.0, 1.0) - state.image
    seen = None if state.objective is None else state.objective.value(difference)
    error = difference.square_().flatten(1)
    psnr = _decibel(float(error.mean()))
    ef_psnr = math.nan if state.band is None else _decibel(float(error.index_select(1, state.band).mean()))
    entry = HistoryEntry(state.iteration, state.seconds(), loss, psnr, ef_psnr, len(gaussians.means))
    state.history.append(entry)
    score = psnr if seen is None else _decibel(seen)
    if score > state.best_score:
        state.best_score, state.best = score, gaussians.detached()


def _decibel(mean_square: float) -> float:
    """PSNR of a mean squared error, for values in [0, 1]."""
    return math.inf if mean_square == 0 else -10.0 * math.log10(mean_square)
