"""Feature networks at run time: onnxruntime, shipped weights, no torch."""

from localizer.features.extractor import FeatureExtractor, OnnxExtractor, load_extractor
from localizer.features.gradient import GradientExtractor

__all__ = ["FeatureExtractor", "GradientExtractor", "OnnxExtractor", "load_extractor"]
