"""What moves the Gaussians: our optimizer and those of published methods."""

from .adan import Adan
from .base import GaussianOptimizer
from .frame_adam import FrameAdam
from .gaussian_image import GaussianImageAdan
from .image_gs import ImageGSAdam

__all__ = ["Adan", "FrameAdam", "GaussianImageAdan", "GaussianOptimizer", "ImageGSAdam"]
