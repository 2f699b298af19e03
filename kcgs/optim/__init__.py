"""Optimizers of Gaussians."""

from .adam import is_within
from .descent import FieldOptimizer, FieldState, move_field, set_rates, step_field
from .gaussian_adam import COLOR_LEARNING_RATE, LEARNING_RATE, GaussianAdam
from .gaussians import Gaussians, Renderer, draft_cutoff
from .newton import NewtonDescent, self_product
from .objectives import ImageObjective, Loss, LossObjective, Objective, SquaredError
from .registry import OBJECTIVES
from .reparametrized import ReparametrizedOptimizer
from .run import End, Event, TimedAction, cosine_decay, count_iterations, run

# public; other packages of kcgs use the other imports
__all__ = ["FieldOptimizer", "GaussianAdam", "ReparametrizedOptimizer"]
