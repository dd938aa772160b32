"""Several retrieval methods on one project, under equal conditions (sections 4.3 to 4.5)."""

from colmap_netvlad.compare.pipeline import CompareOptions, compare
from colmap_netvlad.compare.result import Comparison, read_json

__all__ = ["CompareOptions", "Comparison", "compare", "read_json"]
