"""How good an answer is: matching, metrics, truth files.

Scenes are the dictionaries that `derender show --json` prints (see `derender.report.scene_json`), so that the answer of
another system can be judged as well as ours.
"""

from derender.evaluation.convex import intersection_over_union, intersection_volume
from derender.evaluation.metrics import compare_scenes, edges_of, f1, mask_f1, match_planes, match_solids

__all__ = [
    "compare_scenes",
    "edges_of",
    "f1",
    "intersection_over_union",
    "intersection_volume",
    "mask_f1",
    "match_planes",
    "match_solids",
]
