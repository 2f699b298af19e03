"""Fit a scene of Gaussians to an image."""

from .checks import check_image_and_regions, check_num_gaussians, default_num_gaussians
from .config import FitConfig, available_recipes, config_for
from .contour_moves import move_contours
from .initial import initial_field
from .loop import describe_excess, fit, fit_problem, precompile
from .problem import Problem, make_problem
from .pursuit import propose_for, propose_gaussians
from .ranking import rank_gaussians
from .region_report import RegionReport, report_regions
from .removal import lowest_impact, lowest_weighted_impact
from .result import FitResult, HistoryEntry
from .state import FitState
from .user_objects import Densifier

# the public names; other packages of kcgs use the other imports
__all__ = [
    "Densifier", "FitConfig", "FitResult", "FitState", "HistoryEntry", "RegionReport", "available_recipes", "fit",
    "initial_field", "lowest_impact", "precompile", "propose_gaussians", "rank_gaussians",
]  # fmt: skip
