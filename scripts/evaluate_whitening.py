"""How white the noise of real frames is once the likelihood `correlated` has taken out what earlier neighbours tell.

    python scripts/evaluate.py whitening                        every labelled frame that shows enough of a plane
    python scripts/evaluate.py whitening --only ycbv_0,gn_mustard

Of each frame as inference looks at it (at most 160 columns), and as it came: the residuals of the pixels of its largest
plane, and the numbers that explain them best. Before: correlations with the pixel to the left and the one above, and
the 99 % quantile of the residuals' sizes against that of a normal of the same variance. After: the greatest correlation
of whitened residuals with any of six neighbours (goal: within .1), and their 99 % quantile against the standard
normal's (goal: near 1); then both where `shared` and `alone` are fitted too, which inference holds for what solids are
not as they are modelled: on a bare table alone so few pixels need them that the others seem too near.
"""

import numpy as np
from arguments import names_in
from evaluate_frames import labelled_frames

from derender.camera.depth_file import read_depth
from derender.detection.calibration import NORMAL_99, correlation, fit_sensor, residuals
from derender.detection.pyramid import reduce
from derender.errors import DerenderError

WIDEST = 160  # columns of the images that inference looks at


def evaluate_whitening(only):
    """Print the table."""
    print("| frame | columns | pixels | left before | above | 99 % before | most after | 99 % after | reach, white "
          "| most, fitted | 99 %, fitted | shared, alone |")  # fmt: skip
    print("|---" * 12 + "|")
    after, tails = {}, {}
    labels, folder = labelled_frames()
    for name in names_in(only, labels, "frame"):
        path = folder / f"{name}_camera.json"
        seen = read_depth(str(path.with_name(f"{name}.png")), str(path), None)
        depth = np.where(np.isfinite(seen.depth) & (seen.depth > 0), seen.depth, np.nan)
        for widest in (WIDEST, depth.shape[1]):
            image, camera, _ = reduce(depth, seen.camera, widest)
            try:
                residual, plane = residuals(np.where(image > 0, image, np.nan), camera, name)
            except DerenderError:
                continue
            fit, free = (fit_sensor([(residual, plane)], also=also) for also in ((), ("shared", "alone")))
            beside = [correlation([residual], *neighbour) for neighbour in ((0, 1), (1, 0))]
            tail = np.nanquantile(np.abs(residual), 0.99) / (NORMAL_99 * np.nanstd(residual))
            key = "reduced" if widest == WIDEST else "as they came"
            for kind, each in ((key, fit), (f"{key}, fitted", free)):
                after.setdefault(kind, []).append(abs(each.correlation[1]))
                tails.setdefault(kind, []).append(each.beyond)
            print(f"| {name} | {image.shape[1]} | {fit.pixels} | {beside[0]:.2f} | {beside[1]:.2f} | {tail:.2f} "
                  f"| {fit.correlation[1]:+.2f} | {fit.beyond:.2f} | {fit.values['reach']:.1f} x "
                  f"{fit.values['reach_down']:.1f}, {fit.values['white']:.3f} | {free.correlation[1]:+.2f} "
                  f"| {free.beyond:.2f} | {free.values['shared']:.3f}, {free.values['alone']:.3f} |",
                  flush=True)  # fmt: skip
    for key, found in after.items():
        within = sum(each <= 0.1 for each in found)
        print(f"frames {key}: whitened within .1 in {within} of {len(found)}, 99 % quantile "
              f"{min(tails[key]):.2f} to {max(tails[key]):.2f} times the normal's")  # fmt: skip
